"""Artefacts by content: a file is named by the SHA-256 of its bytes, so writing it twice is writing it once.

The store is a dependency like the database: it may be away, full, or say nothing for hours. Whoever asks it is told so
within a time limit, by one kind of error whatever the driver raised, and can tell that from an artefact that is gone or
damaged.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, partial
from pathlib import Path
from typing import BinaryIO, TypeVar
from uuid import uuid4

import fsspec

from service.domain.payload import ArtefactPayload

T = TypeVar("T")
KEY = re.compile(r"^[0-9a-f]{2}/(?P<digest>[0-9a-f]{64})\.(?P<suffix>[a-z0-9]{1,8})$")
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_PATIENCE_S = 30.0
_HANGING = 4
"""Calls of a store, each for another file, that may hang in a process before the next are not even begun."""
_PIECE = 2**20
_PROBE = ".probe"
_WHOLE = frozenset({"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss"})
"""Protocols where an object appears as a whole or not at all; to move one there is to copy it."""
_UNSYNCABLE = frozenset({errno.EINVAL, errno.ENOTSUP})
"""What file systems say that keep no promise about folders."""
_out_of_reach: set[Path] = set()
"""Half-written files of this process in folders that were taken away."""
_kept: ContextVar[dict[str, bytes] | None] = ContextVar("kept", default=None)


class ArtefactStoreError(OSError):
    """The store does not take or give anything now: nobody's fault but its own, and a later try may succeed.

    ``full`` says that it refused the bytes for want of room.
    """

    def __init__(self, cause: BaseException) -> None:
        super().__init__(f"{type(cause).__name__}: {cause}"[:500])
        self.full = isinstance(cause, OSError) and cause.errno in _FULL


class ArtefactLostError(LookupError):
    """The store answers and does not have what was written under ``key``."""

    def __init__(self, key: str, what: str) -> None:
        super().__init__(f"artefact {key} {what}; running the same realization again brings it back")
        self.key = key


class ArtefactGoneError(ArtefactLostError):
    """Nothing lies under the key."""


class ArtefactDamagedError(ArtefactLostError):
    """What lies under the key is not what was written: its digest is another."""


@contextmanager
def keeping() -> Iterator[dict[str, bytes]]:
    """While this lasts, artefacts that the store does not take are kept here by their keys, and :meth:`put` succeeds.

    So a result that took an hour is not lost for its picture: the worker sends both home.
    """
    kept: dict[str, bytes] = {}
    token = _kept.set(kept)
    try:
        yield kept
    finally:
        _kept.reset(token)


class ArtefactStore:
    """A folder or bucket behind an fsspec URL; no call waits for it longer than ``patience_s``."""

    def __init__(self, url: str, patience_s: float = _PATIENCE_S) -> None:
        self._url = url
        self._calls = _calls(url)
        self._patience_s = patience_s

    def put(self, data: bytes, suffix: str) -> ArtefactPayload:
        """Write ``data``, or renew its time where it is there; ArtefactStoreError where the store does not take it."""
        made = _artefact(hashlib.sha256(data).hexdigest(), suffix)
        try:
            self._call(made.key, lambda place: place.put(made.key, [data]))
        except ArtefactStoreError:
            kept = _kept.get()
            if kept is None:
                raise
            kept[made.key] = data
        return made

    def put_file(self, file: BinaryIO, suffix: str) -> ArtefactPayload:
        """The same with what a file holds, from its beginning; a folder takes it piece by piece, a bucket at once."""
        digest = hashlib.sha256()
        for piece in _pieces(file):
            digest.update(piece)
        made = _artefact(digest.hexdigest(), suffix)
        self._call(made.key, lambda place: place.put(made.key, _pieces(file)))
        return made

    def read(self, key: str) -> bytes:
        """The bytes under ``key``.

        Raises
        ------
        ArtefactGoneError, ArtefactDamagedError
            They are not there, or not what was written.
        ArtefactStoreError
            The store is away.
        """
        digest = _check(key)["digest"]
        data = self._call(key, lambda place: place.read(key))
        if data is None:
            raise ArtefactGoneError(key, "is gone from the store")
        if hashlib.sha256(data).hexdigest() != digest:
            raise ArtefactDamagedError(key, "is damaged in the store")
        return data

    def probe(self) -> None:
        """Write a few bytes and remove them; ArtefactStoreError where the store does not take them."""
        self._call(_PROBE, lambda place: place.probe())

    def path(self, key: str) -> str:
        """Full path of ``key``; ValueError where it is not a key, since it could point outside the store."""
        _check(key)
        return self._call(key, lambda place: place.path(key))

    def _call(self, name: str, function: Callable[[_Place], T]) -> T:
        try:
            # The driver is loaded and connects within the limit too.
            return self._calls(name, lambda: function(_place(self._url)), self._patience_s)
        except Exception as error:
            # Drivers raise what they like: errors of HTTP libraries, of botocore, of the import of a driver.
            raise ArtefactStoreError(error) from error


class _Calls:
    """Calls of one store, each in a thread of its own, so that none can hold up who asks.

    Nothing ends a call that hangs, as one of a dead file server does: its thread is left behind, and no other is begun
    for the same file. A few of them are proof enough that the store is away.
    """

    def __init__(self) -> None:
        self._hanging: dict[str, threading.Thread] = {}

    def __call__(self, name: str, function: Callable[[], T], patience_s: float) -> T:
        self._hanging = {of: thread for of, thread in self._hanging.items() if thread.is_alive()}
        if name in self._hanging or len(self._hanging) >= _HANGING:
            raise TimeoutError("earlier calls of the store still hang")
        answer: Future[T] = Future()
        thread = threading.Thread(target=_answer, args=(answer, function), name="artefacts", daemon=True)
        thread.start()
        try:
            return answer.result(patience_s)
        except TimeoutError:
            if answer.done():
                raise  # the driver's own
            self._hanging = {**self._hanging, name: thread}
            raise TimeoutError(f"the store did not answer within {patience_s:g} s") from None


def _answer(answer: Future[T], function: Callable[[], T]) -> None:
    try:
        answer.set_result(function())
    except BaseException as error:  # noqa: BLE001 - whoever waits for the answer gets it
        answer.set_exception(error)


class _Place:
    """The store itself: plain calls, which may hang and raise anything."""

    def __init__(self, url: str) -> None:
        self._files, self._root = fsspec.core.url_to_fs(url)
        protocols = {self._files.protocol} if isinstance(self._files.protocol, str) else set(self._files.protocol)
        self._is_local = "file" in protocols
        self._is_whole = not protocols.isdisjoint(_WHOLE)

    def path(self, key: str) -> str:
        return f"{self._root}/{key}"

    def put(self, key: str, pieces: Iterable[bytes]) -> None:
        path = self.path(key)
        if not (self._is_local and _renew(Path(path), _check(key)["digest"])):
            self._write(path, pieces)

    def read(self, key: str) -> bytes | None:
        """What lies there, b"" for what is no file; None where nothing lies there and the store is not away itself."""
        try:
            return self._bytes(self.path(key))
        except IsADirectoryError:
            return b""
        except (FileNotFoundError, NotADirectoryError):
            # A folder that is not there at all is a disk that is not mounted. Buckets know no empty folders.
            home = self._root.partition("/")[0] if self._is_whole else self._root
            if not self._files.isdir(home):
                raise
            return None

    def probe(self) -> None:
        path = f"{self._root}/{_PROBE}"
        self._write(path, [b"hostlens"])
        # Where nothing may be removed it is written over the next time.
        with suppress(OSError):
            self._files.rm_file(path)

    def _bytes(self, path: str) -> bytes:
        if self._is_local:
            return Path(path).read_bytes()
        return bytes(self._files.cat_file(path))

    def _write(self, path: str, pieces: Iterable[bytes]) -> None:
        """Let the bytes appear under ``path`` as a whole: a reader, or a second writer, never sees half a file."""
        if self._is_local:
            _write_file(Path(path), pieces)
        elif self._is_whole:
            self._files.pipe_file(path, b"".join(pieces))
        else:
            beside = f"{path}.{uuid4().hex}.partial"
            self._files.makedirs(self._files._parent(path), exist_ok=True)
            try:
                self._files.pipe_file(beside, b"".join(pieces))
                self._files.mv(beside, path)
            except Exception:
                with suppress(Exception):
                    self._files.rm_file(beside)
                raise


@cache
def _calls(_url: str) -> _Calls:
    """Of each store once for a process: what hangs is known to the next run of a worker too."""
    return _Calls()


@cache
def _place(url: str) -> _Place:
    return _Place(url)


def _check(key: str) -> re.Match[str]:
    found = KEY.match(key)
    if found is None:
        raise ValueError(f"not an artefact key: {key!r}")
    return found


def _artefact(digest: str, suffix: str) -> ArtefactPayload:
    key = f"{digest[:2]}/{digest}.{suffix}"
    _check(key)
    return ArtefactPayload(key=key, digest=digest)


def _pieces(file: BinaryIO) -> Iterator[bytes]:
    file.seek(0)
    return iter(partial(file.read, _PIECE), b"")


def _renew(path: Path, digest: str) -> bool:
    """Whether the bytes lie there already: they, and not only the name, which a crash or a full disk may have left.

    Then only the time is new: by it a file that nothing refers to yet is told from one that nothing refers to any more.
    """
    with suppress(OSError), path.open("rb") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() == digest:
            os.utime(path)
            _sync(path.parent)  # whoever wrote it may not have come so far
            return True
    return False


def _write_file(path: Path, pieces: Iterable[bytes]) -> None:
    """Write a file beside its place, to the disk itself, then move it there; nothing is left where that fails.

    Where the folder was taken away meanwhile, what lies in it half-written is removed with the next file.
    """
    _make_folder(path.parent)
    beside = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    try:
        with beside.open("xb") as file:
            file.writelines(pieces)
            file.flush()
            os.fsync(file.fileno())
        if path.is_dir():
            path.rename(path.with_name(f"{path.name}.{uuid4().hex}.damaged"))
        beside.replace(path)
    except BaseException:
        _remove(beside)
        raise
    _sync(path.parent)
    for left in tuple(_out_of_reach):
        _remove(left)


def _remove(half_written: Path) -> None:
    try:
        half_written.unlink()
    except OSError:
        if not half_written.parent.is_dir():
            _out_of_reach.add(half_written)
            return
    _out_of_reach.discard(half_written)


def _make_folder(folder: Path) -> None:
    if not folder.is_dir():
        _make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


def _sync(folder: Path) -> None:
    """Have the disk confirm the names in a folder: a file without its name is lost as well."""
    descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSYNCABLE:
            raise
    finally:
        os.close(descriptor)
