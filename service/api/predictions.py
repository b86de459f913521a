"""/v1/predictions: bias and scatter to be expected in a lens that nobody has simulated."""

from __future__ import annotations

from fastapi import APIRouter

from service.api.bodies import JsonRoute
from service.api.context import Service
from service.domain.prediction_views import PredictionAnswer
from service.domain.predictions import PredictionRequest
from service.domain.requests import GridRequest, plan
from service.domain.views import Cost

router = APIRouter(prefix="/v1", tags=["answers"], route_class=JsonRoute)


@router.post("/predictions")
def predict(body: PredictionRequest, service: Service) -> PredictionAnswer:
    """Expected bias and scatter of each estimator, from simulated runs of other lenses.

    The runs are those that come with hostlens, and those of ``grids``. Where none is near the lens the answer says so
    (``extrapolating``), and offers the grid that would settle it.
    """
    from service.predictions.answer import answer  # noqa: PLC0415 - what computes loads with the first prediction

    if body.grids:
        for grid_id in body.grids:
            service.grids.grid(grid_id)
        with service.database.read() as connection:
            runs, predictor = service.predictors.find(connection, body.study, body.grids)
    else:
        runs, predictor = service.predictors.find(None, body.study, [])

    def cost_of(request: GridRequest) -> Cost:
        return service.costs.cost(plan(request, service.settings.max_grid_runs).kinds())

    return answer(body, runs, predictor, cost_of)
