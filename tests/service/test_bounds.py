"""Schema and engine say the same of every bound: what one accepts the other does, at submission and on the worker."""

from __future__ import annotations

import copy
import json
import math
import tomllib
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from pydantic import ValidationError

from engine import SpecError, check_realization, realization_from_dict
from service.domain.requests import GridRequest, TooManyRunsError, plan

OWN = tomllib.loads((Path(__file__).resolve().parents[2] / "docs" / "examples" / "my_system.toml").read_text("utf-8"))
CAMERA = {
    **OWN["camera"],
    "name": "another",
    "noise_author": {"std_long_e_s": 0.02, "std_short_e_s": 0.2, "bright_threshold_e_s": 30.0},
    "pupil": {
        **OWN["camera"]["pupil"],
        "pads": [[0.0, 0.9, 0.065]],
        "cold_mask": {"secondary": 0.35, "spider_width": 0.06, "outer_radius": 0.97},
        "zernike_waves_at_547nm": [[4, 0.01]],
    },
}
# Everything that may be asked for, once.
WHOLE: dict[str, Any] = {
    "name": "all of it",
    "systems": [{**OWN, "camera": "WFC3-IR_F160W", "priors": {"q": {"low": 0.5, "high": 1.0, "mean": 0.8, "sd": 0.1}}}],
    "n": [2.0], "r_eff": [0.35], "magnitude": [21.0], "l_eta": [1.0],
    "noise_level": "author", "mass_model": "recommended", "camera": CAMERA,
    "optics": {
        "defocus_nm": 5.0, "jitter": 0.01, "colour": 1.0, "residual": 0.01, "residual_seed": 4, "coarse": 2
    },
    "seed": 3, "replicates": 2,
    "analysis": {
        "profile": "draft", "source_pixels": [20, 20], "regularisation": "gradient",
        "noise_treatment": "diagonal", "mask_inner": 0.4, "mask_outer": 1.6,
        "core_radius": 0.2, "subrays": 2, "source_envelope": True, "ray_margin": 4, "psf_radius": 15, "walkers": 8,
        "chain_length": 100.0, "max_steps": 600, "draws": 30, "agn_position_sd": 0.01, "background_sd": 0.1,
        "max_error": 0.02, "priors": {"slope": {"low": 1.5, "high": 2.5, "mean": 2.0, "sd": 0.1}},
    },
}  # fmt: skip
SCHEMA = GridRequest.model_json_schema()
# The place of a request's values in the specification of a run.
IN_SPEC = {"n": ("host", "n"), "r_eff": ("host", "r_eff"), "magnitude": ("host", "magnitude"), "l_eta": ("l_eta",)}
# A grid counts its seeds on from the first one, whose bound is lower than a run's; the others are no part of a run.
OF_THE_GRID_ALONE = {"seed", "replicates", "name"}


def parts_of(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A schema without references and alternatives."""
    if "$ref" in schema:
        yield from parts_of(SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]])
    for part in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from parts_of(part)
    yield schema


def leaves(value: Any, schemas: list[dict[str, Any]], steps: tuple[Any, ...] = ()) -> Iterator[tuple[Any, Any]]:
    """Every number, text and list of a document with what the schema says of it."""
    found = [part for schema in schemas for part in parts_of(schema)]
    if isinstance(value, dict):
        for name, part in value.items():
            below = [one["properties"][name] for one in found if name in one.get("properties", ())]
            below += [one["additionalProperties"] for one in found if isinstance(one.get("additionalProperties"), dict)]
            below += [tail for one in found for tail in one.get("patternProperties", {}).values()]
            yield from leaves(part, below, (*steps, name))
        return
    yield steps, found
    if isinstance(value, list):
        for place, part in enumerate(value):
            below = [one["prefixItems"][place] for one in found if place < len(one.get("prefixItems", ()))]
            below += [one["items"] for one in found if isinstance(one.get("items"), dict)]
            yield from leaves(part, below, (*steps, place))


def around(value: Any, schemas: list[dict[str, Any]]) -> Iterator[Any]:
    """Values at each bound and just on either side of it."""
    for schema in schemas:
        for name in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum"):
            if name in schema and schema.get("type") == "integer":
                yield from (int(schema[name]) + step for step in (-1, 0, 1))
            elif name in schema:
                bound = float(schema[name])
                yield from (math.nextafter(bound, -math.inf), bound, math.nextafter(bound, math.inf))
        for name in ("minItems", "maxItems"):
            if name in schema and isinstance(value, list) and value:
                yield from ((value * (schema[name] + 1))[: max(schema[name] + step, 0)] for step in (-1, 0, 1))
        for name in ("minLength", "maxLength"):
            if name in schema and isinstance(value, str):
                yield from ("x" * max(schema[name] + step, 0) for step in (-1, 0, 1))


def changed(document: dict[str, Any], steps: tuple[Any, ...], value: Any) -> dict[str, Any]:
    document = copy.deepcopy(document)
    place = document
    for step in steps[:-1]:
        place = place[step]
    place[steps[-1]] = value
    return document


def at(document: Any, steps: tuple[Any, ...]) -> Any:
    return reduce(lambda place, step: place[step], steps, document)


def without_properties_of_characters(schema: Any) -> Any:
    """A schema that Python's regular expressions can read: they know no classes of characters."""
    if isinstance(schema, dict):
        kept = {name: part for name, part in schema.items() if not (name == "pattern" and r"\p" in part)}
        return {name: without_properties_of_characters(part) for name, part in kept.items()}
    return [without_properties_of_characters(part) for part in schema] if isinstance(schema, list) else schema


def steps_in_spec(steps: tuple[Any, ...]) -> tuple[Any, ...]:
    if steps[0] == "systems":
        return ("system", *steps[2:])
    return IN_SPEC.get(steps[0], steps)


VALIDATOR = jsonschema.Draft202012Validator(without_properties_of_characters(SCHEMA))
SPEC = next(iter(plan(GridRequest.model_validate(WHOLE), 10))).spec
PLACES = {steps: list(around(at(WHOLE, steps), schemas)) for steps, schemas in leaves(WHOLE, [SCHEMA])}


def test_the_bounds_of_all_that_may_be_asked_for_are_tried() -> None:
    bounded = [steps for steps, values in PLACES.items() if values]
    assert len(bounded) > 100
    assert {steps[0] for steps in bounded} == set(WHOLE) - {"noise_level"}


@pytest.mark.parametrize(
    "steps", [steps for steps, values in PLACES.items() if values], ids=lambda steps: ".".join(map(str, steps))
)
def test_what_the_schema_accepts_the_engine_accepts_and_the_other_way_round(steps: tuple[Any, ...]) -> None:
    for value in PLACES[steps]:
        document = changed(WHOLE, steps, value)
        by_schema = VALIDATOR.is_valid(document)
        request, whole = read(document)
        # A check across several fields, which no schema can say, may refuse more; nothing may refuse less.
        assert (request is not None) == by_schema or (by_schema and whole), (value, by_schema)
        if steps[0] not in OF_THE_GRID_ALONE and not (len(steps) == 1 and isinstance(value, list)):
            assert reads(changed(SPEC, steps_in_spec(steps), value)) == (request is not None), value
        if request is not None:
            try:
                (first, *_) = plan(request, 10)
            except (SpecError, TooManyRunsError):
                continue  # refused at submission, for the whole of it: no run was made
            else:
                check_realization(realization_from_dict(json.loads(json.dumps(first.spec))))


def read(document: dict[str, Any]) -> tuple[GridRequest | None, bool]:
    """The request, or None and whether it is the whole of several fields that is refused."""
    try:
        return GridRequest.model_validate(document), False
    except ValidationError as error:
        return None, any("error" in found.get("ctx", ()) for found in error.errors())


def reads(spec: dict[str, Any]) -> bool:
    """Whether a worker takes a specification."""
    try:
        realization_from_dict(spec)
    except SpecError:
        return False
    return True
