"""Types of single settings: each refuses what it cannot be, and says what it can."""

from __future__ import annotations

import ipaddress
import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_settings import NoDecode

_MIN_MEMORY = 10**8
_SIZES = {prefix: 1000**power for power, prefix in enumerate(("", "k", "M", "G", "T"))} | {
    f"{prefix}i": 1024 ** (power + 1) for power, prefix in enumerate(("k", "M", "G", "T"))
}


def _json_list(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        raise ValueError('allowed is a JSON list of texts, as ["a", "b"]') from None


def _home(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"~ cannot be replaced: {error}") from None


def _memory(value: str) -> str:
    matched = re.fullmatch(r"(\d+(?:\.\d+)?) *([kKMGT]i?)?B", value)
    number, prefix = ("0", None) if matched is None else matched.groups()
    size = float(number) * _SIZES[(prefix or "").replace("K", "k")]
    if not _MIN_MEMORY <= size < 2.0**60:
        raise ValueError("allowed is a size as 2GiB or 4GB, of 100MB at least")
    return value


def _worker_memory(value: str) -> str:
    try:
        return value if value == "auto" else _memory(value)
    except ValueError as error:
        raise ValueError(f"{error}, or auto") from None


def _database(value: str) -> str:
    """The URL of a database that this service can use; a password in it is never repeated."""
    # These take a while to load, and most have no such setting.
    from sqlalchemy.engine import make_url  # noqa: PLC0415

    from service.store.address import DriverMissingError, SqliteAddress, read_address  # noqa: PLC0415

    try:
        address = read_address(value)
    except DriverMissingError:
        return value  # a worker needs no driver; what connects says that it lacks one
    if isinstance(address, SqliteAddress):
        url = make_url(value)
        return url.set(database=str(_home(Path(str(url.database))))).render_as_string(hide_password=False)
    return value


def _artefacts(value: str) -> str:
    protocol, separator, path = value.partition("://")
    if not separator:
        return str(_home(Path(value)))
    if not path:
        raise ValueError("it names no place; allowed is a folder or an fsspec URL, as s3://bucket")
    if protocol in {"file", "local"}:
        return f"{protocol}://{_home(Path(path))}"
    if protocol == "memory":
        raise ValueError("memory:// is not shared by processes; allowed is a folder or an fsspec URL, as s3://bucket")
    return value


def _host(value: str) -> str:
    host = value[1:-1] if value.startswith("[") and value.endswith("]") else value
    if re.fullmatch(r"[A-Za-z0-9._:%-]+", host) is None or (":" in host and not _is_ipv6(host)):
        raise ValueError("allowed is the name or the address of a host, as 127.0.0.1 or ::1")
    return host


def _is_ipv6(host: str) -> bool:
    try:
        return bool(ipaddress.IPv6Address(host))
    except ValueError:
        return False


def _dask_address(value: str) -> str:
    matched = re.fullmatch(r"(?:(?:tcp|tls)://)?(?:\[([0-9A-Fa-f:.%\w]+)\]|[A-Za-z0-9._-]+):(\d{1,5})", value)
    if matched is None or (matched[1] and not _is_ipv6(matched[1])) or not 0 < int(matched[2]) < 65536:
        raise ValueError("allowed is tcp://host:port or tls://host:port, as tcp://10.0.0.1:8786 or tcp://[::1]:8786")
    return value


def _walltime(value: str) -> str:
    if re.fullmatch(r"(\d+-)?\d+(:\d{1,2}){0,2}", value) is None:
        raise ValueError("allowed is a time as Slurm takes it, as 24:00:00 or 2-12:00")
    return value


Seconds = Annotated[float, Field(gt=0.0, le=7 * 86400.0, allow_inf_nan=False)]
Home = Annotated[Path, AfterValidator(_home)]
Memory = Annotated[str, AfterValidator(_memory)]
Host = Annotated[str, AfterValidator(_host)]
DaskAddress = Annotated[str, AfterValidator(_dask_address)]
Lines = Annotated[list[str], NoDecode, BeforeValidator(_json_list)]
Hosts = Annotated[list[Host], NoDecode, BeforeValidator(_json_list)]
ClusterKind = Literal["local", "address", "slurm", "kubernetes"]
LogLevel = Annotated[
    Literal["DEBUG", "INFO", "WARNING", "ERROR"],
    BeforeValidator(lambda level: level.upper() if isinstance(level, str) else level),
]
WorkerMemory = Annotated[str, AfterValidator(_worker_memory)]
Walltime = Annotated[str, AfterValidator(_walltime)]
DatabaseUrl = Annotated[str, AfterValidator(_database)]
ArtefactUrl = Annotated[str, AfterValidator(_artefacts)]
KubernetesMemory = Annotated[str, Field(pattern=r"^[0-9]+(\.[0-9]+)?(k|[KMGT]i?)?$")]
