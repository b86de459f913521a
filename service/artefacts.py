"""Artefacts by content: a file is named by the SHA-256 of its bytes, so writing it twice is writing it once."""

from __future__ import annotations

import hashlib
import re
from typing import Any
from uuid import uuid4

import fsspec

from service.payload import ArtefactPayload

KEY = re.compile(r"^[0-9a-f]{2}/[0-9a-f]{64}\.[a-z0-9]{1,8}$")


class ArtefactStore:
    """A folder or bucket behind an fsspec URL."""

    def __init__(self, url: str) -> None:
        # auto_mkdir concerns local folders; the drivers of other stores would not know it.
        options: dict[str, Any] = {"auto_mkdir": True} if _is_local(url) else {}
        self._files, self._root = fsspec.core.url_to_fs(url, **options)

    def put(self, data: bytes, suffix: str) -> ArtefactPayload:
        """Write ``data``, also where it is there already; OSError where the store does not take it.

        What lies there may be damaged, or so old that somebody takes it for an orphan: see :mod:`service.orphans`.
        """
        digest = hashlib.sha256(data).hexdigest()
        key = f"{digest[:2]}/{digest}.{suffix}"
        path = self.path(key)
        # Written beside its place and moved: a reader, or a second worker, never sees half a file.
        partial = f"{path}.{uuid4().hex}.partial"
        self._files.pipe_file(partial, data)
        self._files.mv(partial, path)
        return ArtefactPayload(key=key, digest=digest)

    def read(self, key: str) -> bytes:
        """The bytes under ``key``; FileNotFoundError where they are gone."""
        data = self._files.cat_file(self.path(key))
        if not isinstance(data, bytes):
            raise TypeError(type(data))
        return data

    def path(self, key: str) -> str:
        """Full path of ``key``; ValueError where it is not a key, since it could point outside the store."""
        if not KEY.match(key):
            raise ValueError(f"not an artefact key: {key!r}")
        return f"{self._root}/{key}"


def _is_local(url: str) -> bool:
    return "://" not in url or url.startswith(("file://", "local://"))
