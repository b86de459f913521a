"""/v1/runs/{id}/products, /fits, /chain.nc and /record: a run as files that stand alone."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Response
from numpy.typing import NDArray
from pydantic_core import to_json

from service.api.context import Context, RunId, Service
from service.api.downloads import artefact
from service.api.threads import Route, patient
from service.domain.views import RunRecord
from service.exports.products import NoChainError, NoProductsError, chain_file, fits_file, provenance, read_products
from service.exports.record import read_found, record
from service.store.artefacts import ArtefactDamagedError
from service.store.runs import NotFoundError

router = APIRouter(prefix="/v1", tags=["grids"], route_class=Route)
IfNoneMatch = Annotated[str | None, Header()]


def _binary(media_type: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}}


@router.get("/runs/{run_id}/products", response_class=Response, responses=_binary("application/zip"))
@patient
def products(run_id: RunId, service: Service, if_none_match: IfNoneMatch = None) -> Response:
    """Every array of the run as NPZ, as its worker wrote it; 410 or 500 where it is gone or damaged."""
    answer = artefact(service.artefacts, _key(_stored(service, run_id)), "application/zip", if_none_match)
    answer.headers["Content-Disposition"] = _attachment(run_id, "npz")
    return answer


@router.get("/runs/{run_id}/fits", response_class=Response, responses=_binary("application/fits"))
@patient
def maps(run_id: RunId, service: Service) -> Response:
    """Observation, model, residual, source, chain and where they come from, as FITS; 410 or 500 as products."""
    found = _stored(service, run_id)
    return _file(fits_file(_arrays(service, found), provenance(found)), run_id, "fits", "application/fits")


@router.get("/runs/{run_id}/chain.nc", response_class=Response, responses=_binary("application/x-netcdf"))
@patient
def chain(run_id: RunId, service: Service) -> Response:
    """The chain as NetCDF in ArviZ's groups; 404 where the analysis needed none, 410 or 500 as products."""
    found = _stored(service, run_id)
    try:
        data = chain_file(_arrays(service, found), found)
    except NoChainError as error:
        raise NotFoundError(str(error)) from error
    return _file(data, run_id, "nc", "application/x-netcdf")


@router.get("/runs/{run_id}/record", response_model=RunRecord)
def show_record(run_id: RunId, service: Service) -> Response:
    """All that is needed to compute the run again without the service, and what it found: hostlens replay reads it."""
    found = _stored(service, run_id)
    with service.database.read() as connection:
        values = read_found(connection, run_id)
    if values is None:
        raise NotFoundError(f"run {run_id} has no result")
    headers = {"Content-Disposition": _attachment(run_id, "json")}
    return Response(to_json(record(found, values)), media_type="application/json", headers=headers)


def _stored(service: Context, run_id: str) -> dict[str, Any]:
    """A run with its result as plain data."""
    _, found = service.grids.run_document(run_id)
    if found["result"] is None:
        raise NotFoundError(f"run {run_id} has no result")
    return found


def _key(found: dict[str, Any]) -> str:
    key: str | None = found["result"]["products"]
    if key is None:
        raise NotFoundError(f"run {found['id']} has no products")
    return key


def _arrays(service: Context, found: dict[str, Any]) -> dict[str, NDArray[Any]]:
    key = _key(found)
    try:
        return read_products(service.artefacts.read(key))
    except NoProductsError as error:
        raise ArtefactDamagedError(key, str(error)) from error


def _file(data: bytes, run_id: str, suffix: str, media_type: str) -> Response:
    return Response(data, media_type=media_type, headers={"Content-Disposition": _attachment(run_id, suffix)})


def _attachment(run_id: str, suffix: str) -> str:
    return f'attachment; filename="hostlens-{run_id}.{suffix}"'
