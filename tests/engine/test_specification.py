"""Specifications, the catalogue and grids: what is accepted, what is refused and how it is told."""

import json
from dataclasses import replace
from importlib.resources import files
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from engine import digest
from engine.catalogue import (
    camera_names,
    load_camera,
    load_dither,
    load_system,
    read_catalogue,
    system_facts,
    system_names,
)
from engine.conventions import (
    image_angle,
    magnitude_to_rate,
    position_angle,
    rate_to_magnitude,
)
from engine.digest import engine_digest
from engine.errors import SpecError
from engine.grid import Grid, expand, preset_names
from engine.simulation.scene import build_scene
from engine.spec.analysis import Analysis
from engine.spec.host import Host
from engine.spec.instrument import Camera
from engine.spec.json_text import read_json
from engine.spec.realization import Realization, realization_from_dict
from engine.spec.sky import LensSystem
from engine.spec.validation import field_path, path_steps

HE0435 = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=21.0))


def zeros(document: object, steps: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Places of the numbers of a document that are floating-point zeros."""
    if isinstance(document, dict | list):
        parts = document.items() if isinstance(document, dict) else enumerate(document)
        return [place for step, part in parts for place in zeros(part, (*steps, step))]
    return [steps] if isinstance(document, float) and document == 0.0 else []


MANY_ZEROS = {
    "system": {
        **TypeAdapter(LensSystem).dump_python(load_system("HE0435"), mode="json"),
        "priors": {"x": {"low": 0.0, "high": 1.0}, "y": {"mean": 0.0, "sd": 1.0}},
    },
    "l_eta": 1.0,
    "host": {"n": 2.0, "r_eff": 0.39, "magnitude": 21.0},
    "optics": {"defocus_nm": 0.0, "jitter": 0.0},
    "analysis": {"mask_inner": 0.0, "core_radius": 0.0},
}
ZEROS = zeros(realization_from_dict(MANY_ZEROS).to_dict())


@given(negative=st.sets(st.sampled_from(ZEROS), min_size=1))
def test_a_negative_zero_is_zero_wherever_it_stands(negative: set[tuple[str | int, ...]]) -> None:
    plain = realization_from_dict(MANY_ZEROS)
    document = plain.to_dict()
    for steps in negative:
        place: Any = document
        for step in steps[:-1]:
            place = place[step]
        place[steps[-1]] = -0.0
    read = realization_from_dict(document)
    assert read == plain
    assert read.digest == plain.digest
    assert read.observation_digest == plain.observation_digest


@pytest.mark.parametrize("kind", [Realization, Grid, Camera])
def test_every_number_that_may_be_zero_is_read_without_its_sign(kind: type) -> None:
    adapter = TypeAdapter(kind)
    found = 0
    waiting: list[Any] = [adapter.core_schema]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict):
            if part.get("type") == "function-after" and part["schema"].get("type") == "float":
                found += 1
                continue
            if part.get("type") == "float":
                assert part.get("gt", -1.0) >= 0.0 or part.get("ge", -1.0) > 0.0, part
            waiting.extend(value for key, value in part.items() if key not in {"metadata", "ref"})
        elif isinstance(part, list | tuple):
            waiting.extend(part)
    assert found or kind is Grid


def test_all_eight_systems_and_three_cameras_load() -> None:
    assert system_names() == (
        "HE0435",
        "HE1104",
        "SDSS1206",
        "WFI2033",
        "HE0047",
        "SDSS0246",
        "HS2209",
        "RXJ1131",
    )
    assert len(camera_names()) == 3
    for name in system_names():
        system = load_system(name)
        assert load_camera(system.camera).name == system.camera
        assert load_dither(system.exposures.dither).shifts
        for l_eta in (0.8, 1.0, 1.2):
            assert system.mass_model("recommended", l_eta).slope == pytest.approx(1.0 + l_eta)


def test_every_number_of_the_catalogue_has_a_source_and_a_confidence() -> None:
    for name in system_names():
        facts = system_facts(name)
        groups = [facts[key] for key in ("redshift_lens", "redshift_source", "table1", "agn", "deflector", "exposures")]
        groups += [model for by_slope in facts["mass_models"].values() for model in by_slope.values()]
        for group in groups:
            assert group["source"]
            assert group["confidence"] in {"published", "derived", "memory"}


def test_the_papers_grid_has_48_runs_a_system_numbered_as_in_table_3() -> None:
    runs = expand(Grid(preset="h0licow-vi/HE0435"))
    assert [run.paper_run for run in runs] == list(range(1, 49))
    table3 = {1: (2, 0.39, 0.8), 4: (4, 0.78, 0.8), 6: (4, 0.39, 1.0), 11: (2, 0.78, 1.2), 12: (4, 0.78, 1.2)}
    for serial, (n, r_eff, l_eta) in table3.items():
        for brightness, magnitude in enumerate((20.5, 21.0, 21.5, 22.0)):
            spec = runs[12 * brightness + serial - 1].realization
            assert (spec.host.n, spec.host.r_eff, spec.l_eta, spec.host.magnitude) == (n, r_eff, l_eta, magnitude)
    assert len(expand(Grid(preset="h0licow-vi"))) == 8 * 48
    assert len({run.realization.digest for run in expand(Grid(preset="h0licow-vi"))}) == 384
    assert "h0licow-vi/RXJ1131" in preset_names()


def test_the_numbering_is_data() -> None:
    table = read_catalogue("h0licow_vi")
    assert len(table["runs"]) == 48
    assert len(table["serials"]) == 12


def test_cuts_and_replicates() -> None:
    grid = Grid(
        preset="h0licow-vi/HE0435", n=(2.0, 4.0), magnitude=(20.5, 21.5), l_eta=(1.0,), r_eff=(0.39,), replicates=2
    )
    runs = expand(grid)
    assert [run.label for run in runs] == [f"HE0435/{k:02d}#{j}" for k in (5, 6, 29, 30) for j in (1, 2)]
    assert {run.realization.seed for run in runs} == {0, 1}


def test_a_free_grid_has_every_combination() -> None:
    grid = Grid(systems=("HE0435", "RXJ1131"), n=(1.0,), r_eff=(0.2, 0.3), magnitude=(21.0,), l_eta=(0.8, 1.2))
    assert len(expand(grid)) == 8


@pytest.mark.parametrize(
    ("grid", "field"),
    [
        (Grid(preset="nothing"), "preset"),
        (Grid(preset="h0licow-vi/HE0435", n=(3.0,)), "n"),
        (Grid(preset="h0licow-vi/HE0435", magnitude=()), "magnitude"),
        (Grid(preset="h0licow-vi/HE0435", systems=("RXJ1131",)), "systems"),
        (Grid(systems=("HE0435",), n=(2.0,)), "r_eff"),
        (Grid(systems=("nowhere",), n=(2.0,), r_eff=(0.4,), magnitude=(21.0,), l_eta=(1.0,)), "system"),
        (Grid(systems=("HE0435",), n=(2.0,), r_eff=(0.4,), magnitude=(21.0,), l_eta=(0.9,)), "l_eta"),
        (Grid(systems=("HE0435",), n=(2.0, 2.0), r_eff=(0.4,), magnitude=(21.0,), l_eta=(1.0,)), "n"),
        (Grid(preset="h0licow-vi/HE0435", mass_model="dark"), "mass_model"),
    ],
)
def test_a_grid_that_cannot_be_is_refused_by_field(grid: Grid, field: str) -> None:
    with pytest.raises(SpecError) as caught:
        expand(grid)
    assert caught.value.field == field
    assert caught.value.allowed


def test_a_realization_survives_json_and_keeps_its_digest() -> None:
    again = realization_from_dict(json.loads(json.dumps(HE0435.to_dict())))
    assert again == HE0435
    assert again.digest == HE0435.digest


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"host": {"n": 99, "r_eff": 0.4, "magnitude": 21}}, "host.n"),
        ({"host": {"n": 2, "r_eff": float("nan"), "magnitude": 21}}, "host.r_eff"),
        ({"l_eta": 7.0}, "l_eta"),
        ({"seed": -1}, "seed"),
        ({"noise_level": "none"}, "noise_level"),
        ({"unheard_of": 1}, "unheard_of"),
        ({"analysis": {"source_pixels": [1, 30]}}, "analysis.source_pixels[0]"),
    ],
)
def test_a_bad_realization_is_refused_by_field(change: dict[str, object], field: str) -> None:
    with pytest.raises(SpecError) as caught:
        realization_from_dict(HE0435.to_dict() | change)
    assert caught.value.field == field


def test_another_seed_or_setting_is_another_realization() -> None:
    others = [
        Realization(system="HE0435", l_eta=1.0, host=HE0435.host, seed=1),
        Realization(system="HE0435", l_eta=1.0, host=HE0435.host, analysis=Analysis(subrays=3)),
        Realization(system="HE0435", l_eta=1.0, host=HE0435.host, noise_level="handbook"),
    ]
    assert len({HE0435.digest, *(other.digest for other in others)}) == 4


def test_a_system_of_ones_own_runs_like_one_of_the_catalogue() -> None:
    own = Realization(system=load_system("HE0435"), l_eta=1.0, host=HE0435.host)
    assert realization_from_dict(own.to_dict()) == own
    assert build_scene(own).agn == build_scene(HE0435).agn


def test_the_scene_turns_sky_into_image_once() -> None:
    scene = build_scene(HE0435)
    mass = load_system("HE0435").mass_model("recommended", 1.0)
    assert (scene.host.x, scene.host.y) == (-mass.source_position[0], mass.source_position[1])
    assert position_angle(scene.lens.phi) == pytest.approx(mass.position_angle)
    # Image A lies to the East (x_image < 0) and North, and is the brightest.
    by_name = {source.name: source for source in scene.agn}
    assert by_name["A"].x < -1.0
    assert by_name["A"].y > 0.4
    assert max(scene.agn, key=lambda source: source.flux).name == "A"
    assert scene.host.flux == pytest.approx(10 ** (0.4 * (25.9463 - 21.0)))


def test_a_wrong_number_of_agn_images_is_refused() -> None:
    system = load_system("HE0435")
    wrong = Realization(system=type(system)(**{**system.__dict__, "agn": system.agn[:3]}), l_eta=1.0, host=HE0435.host)
    with pytest.raises(SpecError, match="agn"):
        build_scene(wrong)


@given(angle=st.floats(0, 179.99))
def test_position_angles_go_there_and_back(angle: float) -> None:
    difference = abs(position_angle(image_angle(angle)) - angle)
    assert min(difference, 180 - difference) < 1e-9


def test_magnitudes_and_rates_go_there_and_back() -> None:
    assert rate_to_magnitude(magnitude_to_rate(21.3, 25.9463), 25.9463) == pytest.approx(21.3)
    with pytest.raises(ValueError, match="rate"):
        rate_to_magnitude(0.0, 25.9)


def test_estimators_are_left_out_where_all_are_wanted_and_have_one_order() -> None:
    assert "estimators" not in HE0435.to_dict()["analysis"]
    one, other = (
        replace(HE0435, analysis=Analysis(estimators=names)) for names in (("image", "paper"), ("paper", "image"))
    )
    assert one.to_dict()["analysis"]["estimators"] == ["paper", "image"]
    assert one.digest == other.digest != HE0435.digest
    assert realization_from_dict(one.to_dict()) == one
    assert one.observation_digest == HE0435.observation_digest
    # The digest of this specification before there was the field.
    assert HE0435.digest == "a89bc559c7ef9ce4b565071fab827c4f2eb82c037a4f5b999a4a02a9d5eb34a1"


@pytest.mark.parametrize("names", [[], ["image", "image"], ["galfit"]])
def test_estimators_that_make_no_sense_are_refused(names: list[str]) -> None:
    with pytest.raises(SpecError, match="estimators"):
        realization_from_dict(HE0435.to_dict() | {"analysis": {"estimators": names}})


def test_another_picture_of_the_same_numbers_is_no_other_engine() -> None:
    names = [name for name, _ in digest._walk(files("engine"))]
    assert {"lensing/power_law.py", "catalogue/systems.yaml", "experiment.py"} <= set(names)
    assert not [name for name in names if name.startswith("figures/")]


def test_the_engine_digest_is_a_sha256_and_stays() -> None:
    assert len(engine_digest()) == 64
    assert engine_digest() == engine_digest()


@given(st.lists(st.one_of(st.integers(0, 10**6), st.text()), min_size=1, max_size=5))
def test_a_path_that_people_read_leads_back_to_its_steps(steps: list[int | str]) -> None:
    assert path_steps(field_path(steps)) == tuple(steps)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('{"a": {"b": 1, "b": 2}}', "a.b"),
        ('[{"x y": 1, "x y": 1}]', '[0]["x y"]'),
        ('{"a": "\\ud800"}', "a"),
        ('{"\\udfff": 1}', '["\\udfff"]'),
        ("[" * 33 + "]" * 33, "[0]" * 32),
        ("[" * 100_000, ""),
        ("{", ""),
    ],
    ids=lambda part: part[:20],
)
def test_json_that_is_ambiguous_or_endless_is_refused_by_its_place(text: str, field: str) -> None:
    with pytest.raises(SpecError) as caught:
        read_json(text)
    assert caught.value.field == field


def test_json_numbers_beyond_all_bounds_are_left_to_the_fields() -> None:
    assert read_json("[1e400, " + "9" * 5000 + ', NaN, "\\ud83d\\ude00"]')[:2] == [float("inf")] * 2
