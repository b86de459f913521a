"""Tables of the reference say what the code says."""

from __future__ import annotations

import json
import re

import pytest
from pydantic_core import PydanticUndefined

from engine.parametric.constraints import GALAXY, POSITION_ERROR, WIDE
from engine.reconstruction import POOR_FIT
from service.domain.states import TRANSITIONS, RunState
from service.runtime.settings import Settings
from tests.docs.openapi import FILE, document_text
from tests.docs.pages import ROOT


def test_the_committed_openapi_document_is_that_of_the_application() -> None:
    assert FILE.read_text() == document_text(), "write it anew: python -m tests.docs.openapi"


def test_every_setting_is_listed_with_its_default() -> None:
    text = (ROOT / "docs" / "reference" / "settings.md").read_text()
    listed = dict(re.findall(r"^\| `(HOSTLENS_\w+)` \| ([^|]+?) \|", text, re.MULTILINE))
    fields = {f"HOSTLENS_{name.upper()}": field for name, field in Settings.model_fields.items()}
    assert listed.keys() == fields.keys()
    for name, field in fields.items():
        told = listed[name]
        if not told.startswith("`"):
            assert field.default is None, f"{name} has a default"
            continue
        default = field.default_factory() if field.default is PydanticUndefined else field.default
        said = json.dumps(default) if isinstance(default, bool | list) else str(default)
        assert told.strip("`") in (said, said.removesuffix(".0")), f"{name} is {said} without a setting"


def test_the_picture_of_the_states_has_every_state_and_transition() -> None:
    picture = (ROOT / "docs" / "images" / "states.svg").read_text()
    words = re.findall(r"<text[^>]*>([^<]+)</text>", picture)
    assert set(words) == set(RunState) | set(TRANSITIONS) | {"submit"}


def test_every_operation_is_in_the_table_of_the_api() -> None:
    text = (ROOT / "docs" / "reference" / "api.md").read_text()
    listed = {re.sub(r"\{\w+\}", "{}", found) for found in re.findall(r"`((?:GET|POST) /[\w/{}.]+)`", text)}
    paths = json.loads(FILE.read_text())["paths"]
    operations = {
        re.sub(r"\{\w+\}", "{}", f"{method.upper()} {path}") for path, methods in paths.items() for method in methods
    }
    assert operations <= listed, sorted(operations - listed)


@pytest.mark.parametrize("page", ["measure-an-image", "quote-a-host"])
def test_priors_that_decide_an_answer_are_told_as_they_are(page: str) -> None:
    text = " ".join((ROOT / "docs" / "howto" / f"{page}.md").read_text().split())
    for told in (
        f"slope {WIDE.slope[0]} ± {WIDE.slope[1]}",
        f"shear 0 ± {WIDE.shear}",
        f"ellipticity 0 ± {WIDE.ellipticity}",
        f"within {WIDE.centre} arcsec (1 sigma)",
        f"to {POSITION_ERROR} arcsec",
        f"bove {POOR_FIT}",
    ):
        assert told in text, told
    if page == "measure-an-image":
        narrow = (
            f"slope {GALAXY.slope[0]} ± {GALAXY.slope[1]}, shear 0 ± {GALAXY.shear}, ellipticity ± {GALAXY.ellipticity}"
        )
        assert narrow in text
        assert f"within {GALAXY.centre} arcsec" in text
