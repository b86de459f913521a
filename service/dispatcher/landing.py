"""What a run that came back means: a result to be stored, one that waits for its artefacts, a failure."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from service.dispatcher.backlog import Backlog, NoRoomError
from service.dispatcher.outcomes import OtherEngine, judge_answer, read_artefacts, read_exception
from service.dispatcher.writer import Writer
from service.domain.payload import Payload
from service.runtime import logs
from service.store.leases import Lease, Outcome
from service.store.queue import Failure
from service.worker.answers import Answer

_LOG = logging.getLogger(__name__)


class Landing:
    """Turns answers into endings, and into ones of the backlog where artefacts came home with them."""

    def __init__(self, endings: Writer, backlog: Backlog) -> None:
        self._endings = endings
        self._backlog = backlog

    def land(self, answered: Sequence[tuple[Lease, Answer | BaseException]]) -> None:
        """End runs by what was said of each; results make one ending."""
        results = []
        for lease, said in answered:
            result = self._result(lease, said)
            if result is not None:
                results.append((lease, result))
        self._endings.store(results)

    def attend(self) -> None:
        """Turn results that wait no more for the artefact store into endings."""
        results: list[tuple[Lease, Payload]] = []
        for lease, ending in self._backlog.attend():
            if isinstance(ending, Failure):
                self._fail(lease, ending)
            else:
                results.append((lease, ending))
        self._endings.store(results)

    def _result(self, lease: Lease, said: Answer | BaseException) -> Payload | None:
        """A result that can be stored; anything else is dealt with here."""
        ending: Payload | Failure | OtherEngine
        artefacts: dict[str, bytes] = {}
        try:
            ending = read_exception(said) if isinstance(said, BaseException) else judge_answer(lease, said.answer)
            if isinstance(ending, Payload) and isinstance(said, Answer):
                artefacts = read_artefacts(ending, said.answer)
        except Exception as error:  # noqa: BLE001 - the answer came from another process and may be anything
            ending = read_exception(error)
        if isinstance(ending, Failure):
            self._fail(lease, ending)
        elif isinstance(ending, OtherEngine):
            told = logs.fields_of(lease)
            _LOG.warning("run %s, attempt %d: engine %s", lease.run_id, lease.attempt, ending.digest, extra=told)
            self._endings.refuse_engine(lease, ending.digest)
        elif artefacts:
            self._keep(lease, ending, artefacts)
        else:
            return ending
        return None

    def _fail(self, lease: Lease, failure: Failure) -> None:
        told = {**logs.fields_of(lease), "code": failure.code}
        _LOG.warning("run %s, attempt %d: %s", lease.run_id, lease.attempt, failure.detail, extra=told)
        self._endings.fail(lease, failure)

    def _keep(self, lease: Lease, payload: Payload, artefacts: dict[str, bytes]) -> None:
        """Keep a result until the artefact store takes what came with it; without room for it the run goes back."""
        try:
            self._backlog.add(lease, payload, artefacts)
        except NoRoomError as error:
            detail = f"the artefact store is away and no more results can be kept: {error}"
            _LOG.warning("run %s goes back: %s", lease.run_id, detail, extra=logs.fields_of(lease))
            self._endings.lose(lease, detail, Outcome.HANDED_BACK)
