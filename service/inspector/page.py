"""Serves the inspector page: static files that need nothing from elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from fastapi import FastAPI
from starlette.responses import FileResponse

from looktwice.service.http.openapi import problems
from looktwice.service.problems import NOT_FOUND, ProblemError

_FOLDER: Final = Path(__file__).parent
_MEDIA_TYPES: Final = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_PAGE: Final = "index.html"
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def add_inspector(app: FastAPI) -> None:
    """Add the page at ``/`` and its files below ``/inspector/``."""
    # Fixed at start: what is asked for is looked up here and never becomes a path.
    files = {path.name: path for path in _FOLDER.iterdir() if path.suffix in _MEDIA_TYPES}

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return _response(files[_PAGE])

    @app.get("/inspector/{name}", include_in_schema=False, responses=problems(NOT_FOUND))
    async def file(name: str) -> FileResponse:
        if name not in files:
            raise ProblemError(NOT_FOUND, "the inspector has no such file")
        return _response(files[name])


def _response(path: Path) -> FileResponse:
    return FileResponse(path, media_type=_MEDIA_TYPES[path.suffix], headers=_HEADERS)
