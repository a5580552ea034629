from __future__ import annotations

import importlib.util

import pytest

if importlib.util.find_spec("vllm") is None:
    # `make test-vllm` runs these in an environment of their own.
    collect_ignore_glob = ["test_*.py"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """vLLM's own warnings are not ours to mend."""
    for item in items:
        item.add_marker(pytest.mark.filterwarnings("default"))
