"""A form made of a schema: fields, what was typed as a document, and paths of errors."""

from __future__ import annotations

import json

from service.domain.requests import GridRequest
from service.web.form import document_of, field_of, form_fields

FIELDS = {field.name: field for field in form_fields(GridRequest.model_json_schema())}


def test_every_field_of_a_request_is_in_the_form_and_nothing_else() -> None:
    schema = GridRequest.model_json_schema()
    analysis = schema["$defs"]["AnalysisRequest"]["properties"]
    wanted = {*schema["properties"], *(f"analysis.{name}" for name in analysis)} - {"analysis"}
    assert set(FIELDS) == wanted


def test_fields_are_of_the_kind_of_their_schema() -> None:
    kinds = {name: FIELDS[name].kind for name in ("name", "n", "seed", "systems", "optics", "analysis.mask_inner")}
    assert kinds == {
        "name": "text", "n": "list", "seed": "integer", "systems": "list", "optics": "json",
        "analysis.mask_inner": "number",
    }  # fmt: skip
    assert FIELDS["noise_level"].options == ("author", "handbook")
    assert FIELDS["analysis.profile"].options == ("draft", "standard", "reference", "paper")
    assert FIELDS["analysis.source_envelope"].options == ("true", "false")
    assert "0.3 to 10" in FIELDS["n"].hint


def test_what_is_typed_becomes_the_document_that_the_api_takes() -> None:
    typed = {
        "name": " one ", "systems": "HE0435, RXJ1131", "n": "1, 2.5", "r_eff": "0.39", "magnitude": "[20.5, 21]",
        "l_eta": "1", "seed": "7", "replicates": "", "analysis.profile": "draft", "analysis.source_envelope": "false",
        "analysis.estimators": "image", "analysis.source_pixels": "30, 30", "optics": '{"psf": 1}',
    }  # fmt: skip
    document, wrong = document_of(FIELDS.values(), typed, json.loads)
    assert wrong == {}
    assert document == {
        "name": "one", "systems": ["HE0435", "RXJ1131"], "n": [1, 2.5], "r_eff": [0.39], "magnitude": [20.5, 21],
        "l_eta": [1], "seed": 7, "optics": {"psf": 1},
        "analysis": {"profile": "draft", "source_envelope": False, "estimators": ["image"], "source_pixels": [30, 30]},
    }  # fmt: skip


def test_an_object_alone_is_a_list_of_one_where_a_list_is_wanted() -> None:
    assert FIELDS["systems"].is_long
    assert FIELDS["camera"].is_long
    assert not FIELDS["n"].is_long
    document, _ = document_of(FIELDS.values(), {"systems": '{"name": "mine"}', "camera": '{"name": "c"}'}, json.loads)
    assert document == {"systems": [{"name": "mine"}], "camera": {"name": "c"}}


def test_what_is_no_number_stays_for_the_model_to_refuse_and_what_is_no_json_is_told() -> None:
    document, wrong = document_of(FIELDS.values(), {"seed": "many", "optics": "{"}, json.loads)
    assert document == {"seed": "many"}
    assert list(wrong) == ["optics"]


def test_an_error_is_put_at_the_field_that_holds_its_place() -> None:
    assert field_of(("n", 1), FIELDS) == "n"
    assert field_of(("analysis", "walkers"), FIELDS) == "analysis.walkers"
    assert field_of(("systems", 0, "agn", 1), FIELDS) == "systems"
    assert field_of(("nothing",), FIELDS) == ""
