"""What a process looks at before it starts: whether what the settings name is there and can be used.

What would be no better at the next start is a :class:`~service.runtime.start.ConfigurationError`. What may only be away
for now (a database server, a scheduler) is not looked at: to wait for it is the business of whoever needs it.
"""

from __future__ import annotations

import errno
import importlib
import importlib.util
import logging
import multiprocessing
import os
import shutil
import socket
import ssl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import fsspec
import psutil

from service.runtime.settings import Settings, bracketed
from service.runtime.start import ConfigurationError
from service.store.address import AddressError, SqliteAddress, read_address
from service.store.database import AWAY, Database
from service.store.tokens import TokenStore

_LOG = logging.getLogger(__name__)
API_PORT = "HOSTLENS_HOST and HOSTLENS_PORT"
_EXTRAS = {"slurm": "dask_jobqueue.slurm", "kubernetes": "dask_kubernetes.operator"}
_AWAY = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE})
"""A disk that is full or away for now: that a later start may find otherwise."""


def require_data(settings: Settings) -> None:
    """The data folder, made where it is missing; it can be written."""
    with _refused("HOSTLENS_DATA_DIR"):
        settings.make_folders()
        _require_writable(settings.data_dir)


def require_database(settings: Settings) -> None:
    """The driver of the database, and the folder of one that is a file."""
    variable = "HOSTLENS_DATABASE_URL" if settings.database_url else "HOSTLENS_DATA_DIR"
    try:
        address = read_address(settings.database)
    except AddressError as error:
        raise ConfigurationError(f"{variable}: {error}") from None
    if not isinstance(address, SqliteAddress):
        return
    file = address.file
    with _refused(variable):
        if file.exists() and not file.is_file():
            raise ConfigurationError(f"{variable}: {file} is not a file")
        if file.exists() and not os.access(file, os.R_OK | os.W_OK):
            raise PermissionError(errno.EACCES, "Permission denied", str(file))
        # Beside the database lie its journals.
        _require_writable(file.parent)


def require_artefacts(settings: Settings, *, written: bool = False) -> None:
    """The protocol of the artefact store, and its folder where this machine's workers write to it."""
    protocol, path = fsspec.core.split_protocol(settings.artefacts)
    if protocol in {"http", "https"}:
        raise ConfigurationError(f"HOSTLENS_ARTEFACT_URL: {protocol} takes no files; allowed is a folder or a bucket")
    try:
        fsspec.get_filesystem_class(protocol)
    except (ValueError, ImportError) as error:
        raise ConfigurationError(f"HOSTLENS_ARTEFACT_URL: {error}") from None
    if written and protocol in {None, "file", "local"}:
        with _refused("HOSTLENS_ARTEFACT_URL" if settings.artefact_url else "HOSTLENS_DATA_DIR"):
            Path(path).mkdir(parents=True, exist_ok=True)
            _require_writable(Path(path))


def require_cluster(settings: Settings) -> None:
    """What the workers need of this machine: an extra, certificates, semaphores."""
    kind = settings.kind_of_cluster
    if kind in _EXTRAS:
        _require_module("HOSTLENS_CLUSTER", _EXTRAS[kind], kind)
    if kind == "slurm" and shutil.which("sbatch") is None:
        raise ConfigurationError("HOSTLENS_CLUSTER: slurm needs the command sbatch, which is not in PATH")
    if settings.slurm_interface is not None and settings.slurm_interface not in (found := psutil.net_if_addrs()):
        raise ConfigurationError(
            f"HOSTLENS_SLURM_INTERFACE: got {settings.slurm_interface!r}; allowed is one of {', '.join(found)}"
        )
    require_certificates(settings)
    if kind == "local":
        _require_task(settings.task)
        try:
            # Of this context, or Python would start a process beside this one that cleans up after it.
            multiprocessing.get_context("fork").Lock()
        except OSError as error:
            raise ConfigurationError(
                f"HOSTLENS_CLUSTER: local workers need POSIX semaphores, so a /dev/shm that can be written ({error})"
            ) from None


def require_certificates(settings: Settings) -> None:
    """The files of TLS are there, are PEM, and belong together."""
    if settings.tls_ca is None or settings.tls_cert is None:
        return
    for name in ("tls_ca", "tls_cert", "tls_key"):
        file = getattr(settings, name)
        if file is not None and file.exists() and not file.is_file():
            # A pipe without a writer would be waited for, for ever.
            raise ConfigurationError(f"HOSTLENS_{name.upper()}: {file} is not a regular file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    variables = "HOSTLENS_TLS_CA"
    try:
        context.load_verify_locations(settings.tls_ca)
        variables = "HOSTLENS_TLS_CERT and HOSTLENS_TLS_KEY"
        # A password, or the library would ask for one on a terminal.
        context.load_cert_chain(settings.tls_cert, settings.tls_key, password="")
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{variables}: not PEM files that can be used ({error})") from None


def listening(host: str, port: int, variables: str) -> socket.socket:
    """A socket that listens there: nobody else does, and the host is one of this machine."""
    listener = None
    try:
        (family, kind, _, _, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        listener = socket.socket(family, kind)
        # Connections of an earlier service that are not forgotten yet are no reason to wait.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except (OSError, UnicodeError) as error:
        if listener is not None:
            listener.close()
        said = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{variables}: cannot listen on {bracketed(host)}:{port} ({said})") from None
    return listener


def require_free(host: str, port: int, variables: str) -> None:
    """A process can listen there."""
    listening(host, port, variables).close()


def require_token(settings: Settings) -> None:
    """Somebody can come in, where the API asks for tokens; not looked at while the database is away."""
    if not settings.asks_for_tokens:
        return
    database = Database(settings.database, pooled=False)
    try:
        if TokenStore(database).any_valid():
            return
    except AWAY as error:
        _LOG.warning("whether there is a token is not known: %s", error)
        return
    finally:
        database.close()
    raise ConfigurationError(
        f"HOSTLENS_HOST: {settings.host} asks for tokens and there is none that is valid: make one with "
        "hostlens token create NAME --scope admin, or set HOSTLENS_AUTH=off where a proxy or a firewall guards the API"
    )


def for_api(settings: Settings) -> None:
    """What one API process needs: of the data folder only what lies there."""
    if settings.database_url is None:
        require_data(settings)
    require_database(settings)
    require_artefacts(settings)
    require_token(settings)


def for_dispatcher(settings: Settings) -> None:
    """What a dispatcher needs."""
    require_data(settings)
    require_database(settings)
    require_artefacts(settings, written=settings.kind_of_cluster == "local")
    require_cluster(settings)
    if settings.metrics_port is not None:
        require_free(settings.metrics_host, settings.metrics_port, "HOSTLENS_METRICS_HOST and HOSTLENS_METRICS_PORT")


def for_both(settings: Settings) -> None:
    """What the processes of one machine need together."""
    if settings.metrics_port == settings.port:
        raise ConfigurationError(f"HOSTLENS_METRICS_PORT and HOSTLENS_PORT are both {settings.port}: they must differ")
    # First the data folder, which is made: the URL of the database may name a file in it. The API needs nothing more.
    for_dispatcher(settings)
    require_free(settings.host, settings.port, API_PORT)


@contextmanager
def _refused(variable: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _AWAY:
            raise
        raise ConfigurationError(f"{variable}: cannot use {error.filename}: {error.strerror}") from None


def _require_writable(folder: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        # Its own name says nothing to whoever has to mend it.
        raise OSError(error.errno, error.strerror, str(folder)) from None


def _require_task(task: str) -> None:
    """The module of the task is there; that it can be loaded is told by the first worker, since it may take long."""
    module = task.partition(":")[0]
    try:
        found = importlib.util.find_spec(module)
    except ImportError:
        found = None
    if found is None:
        raise ConfigurationError(f"HOSTLENS_TASK: there is no module {module}")


def _require_module(variable: str, module: str, extra: str) -> None:
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise ConfigurationError(f"{variable}: needs hostlens with its extra {extra} ({error})") from None
