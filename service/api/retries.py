"""What POST /v1/grids/{id}/retry is asked: which of the runs that ended without a result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, create_model

from service.api.problems import InvalidRequestError
from service.domain.states import REVIVE, RunState
from service.store.result_filter import AXES, FilterError, ResultFilter
from service.store.run_filter import RunFilter

_MOST = 1000
_Text = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00]*$")]
_Values = Annotated[list[_Text], Field(max_length=_MOST)]
_ENDED = sorted(REVIVE.sources)
_AXES = {name: axis for name, axis in AXES.items() if name != "grid"}
_axes: dict[str, Any] = {
    name: (_Values, Field(default=[], description=axis.description + ("; a range as 20..22" if axis.is_number else "")))
    for name, axis in _AXES.items()
}
RetryAxes = create_model("RetryAxes", __config__=ConfigDict(extra="forbid"), **_axes)
if TYPE_CHECKING:
    AxesBody = BaseModel
else:
    AxesBody = RetryAxes


class RetryRequest(AxesBody):
    """Runs to try again: of several values in a field any will do, and all fields have to hold."""

    state: list[RunState] = Field(default=[], max_length=_MOST, description=f"Of {', '.join(_ENDED)}")
    error_code: _Values = Field(default=[], description="Of the failure, as in the run's error")

    def wanted(self) -> RunFilter:
        """The runs that are meant; an InvalidRequestError names the field that cannot be."""
        for state in self.state:
            if state not in REVIVE.sources:
                told = f"state: got '{state}', allowed is one of {', '.join(_ENDED)}"
                raise InvalidRequestError("body", "/state", told)
        try:
            axes = ResultFilter.read({name: getattr(self, name) for name in _AXES})
        except FilterError as error:
            raise InvalidRequestError("body", f"/{error.parameter}", str(error)) from error
        return RunFilter(tuple(self.state), tuple(self.error_code), axes)
