"""What vLLM calls in each of its processes to learn of our checkpoints."""

from __future__ import annotations


def register() -> None:
    """Entry point ``vllm.general_plugins``: cheap, and no harm when called again."""
    from vllm import ModelRegistry

    ModelRegistry.register_model("LookTwiceVla", "looktwice.model.engines.vllm.network:LookTwiceForVllm")
