"""What a handler needs of the process that serves it, and the shapes of the parameters that several share."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Annotated

from fastapi import Depends, Path, Query, Request

from service.api.hub import Hub
from service.api.metrics import ApiMetrics
from service.api.threads import QUICK, SharedReads
from service.domain.identifiers import GRID_PATTERN, RUN_PATTERN
from service.figures.kept import KeptFigures
from service.runtime import logs
from service.runtime.kept import KeptBytes
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.costs import CostStore
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.measurements import MeasurementStore
from service.store.outbox import EventStore
from service.store.tokens import TokenStore

if TYPE_CHECKING:
    from service.predictions.kept import KeptPredictors

_KEPT_FIGURES, _KEPT_RUNS = 32 * 2**20, 16 * 2**20
_IDS = frozenset({"grid_id", "run_id"})


class Context:
    """Settings and stores of one API process."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.database = Database(settings.database)
        self.grids = GridStore(self.database)
        self.costs = CostStore(self.database)
        self.events = EventStore(self.database)
        self.measurements = MeasurementStore(self.database)
        self.tokens = TokenStore(self.database)
        self.reads = SharedReads(QUICK)
        self.hub = Hub(self.events, settings.max_streams)
        # A connection of their own each time, or probes would queue behind whoever waits for the database already.
        self.probed = Database(settings.database, pooled=False)
        self.leadership = Leadership(self.probed, settings.leader_ttl_s)
        self.metrics = ApiMetrics(self.database, self.leadership)
        self.artefacts = ArtefactStore(settings.artefacts, patience_s=10.0)
        self.figures = KeptFigures(_KEPT_FIGURES)
        self.runs = KeptBytes(_KEPT_RUNS)

    @cached_property
    def predictors(self) -> KeptPredictors:
        """What predicts, made with the first prediction."""
        from service.predictions.kept import KeptPredictors  # noqa: PLC0415 - loads what computes

        return KeptPredictors()


async def _context(request: Request) -> Context:
    context = request.app.state.context
    if not isinstance(context, Context):
        raise TypeError(type(context))
    return context


Service = Annotated[Context, Depends(_context)]
GridId = Annotated[str, Path(pattern=GRID_PATTERN, description="A grid's identifier")]
RunId = Annotated[str, Path(pattern=RUN_PATTERN, description="A run's identifier")]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items on a page")]


async def bind_ids(request: Request) -> None:
    """Put the grid or run that a request names on every line that is logged for it.

    Not a plain function: what one of those binds stays in the thread that it runs on.
    """
    logs.bind(**{name.removesuffix("_id"): value for name, value in request.path_params.items() if name in _IDS})
