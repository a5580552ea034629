"""Results that are known already, so that a run that was cut goes on behind them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

_Result = TypeVar("_Result")
_BEGIN: Final = '{"key": "'


class ResultStore(Generic[_Result]):
    """Results in a file, one JSON object a line; what a kill left of a line is forgotten.

    Args:
        file: made if it is not there; None keeps them in memory alone.
        field: of a line that holds the result, beside ``key``.
        to_json, from_json: of one result.

    Raises:
        ValueError: the file is something else; it is left as it is.
    """

    def __init__(
        self,
        file: Path | None,
        field: str,
        to_json: Callable[[_Result], Any],
        from_json: Callable[[Any], _Result],
    ) -> None:
        self._file, self._field, self._to_json = file, field, to_json
        text = file.read_text() if file is not None and file.exists() else ""
        whole, _, torn = text.rpartition("\n")
        try:
            lines = [json.loads(line) for line in whole.splitlines()]
            self._results = {line["key"]: from_json(line[field]) for line in lines}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} keeps something else than a {field} in each line: {error!r}") from error
        if torn and file is not None:
            if not torn.startswith(_BEGIN[: len(torn)]):
                raise ValueError(f"{file} ends with something else than a {field}")
            file.write_text(f"{whole}\n" if whole else "")

    def find(self, key: str) -> _Result | None:
        """The result that is stored under a key."""
        return self._results.get(key)

    def store(self, key: str, result: _Result) -> None:
        """Store a result; it is in the file when this returns."""
        self._results[key] = result
        if self._file is not None:
            with self._file.open("a") as file:
                file.write(json.dumps({"key": key, self._field: self._to_json(result)}) + "\n")
