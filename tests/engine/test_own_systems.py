"""Systems and cameras of a user's own: files, mappings and grids; every wrong value is refused by its name."""

import copy
import json
import math
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import (
    EngineError,
    Grid,
    Host,
    Realization,
    SpecError,
    camera_from_mapping,
    expand,
    load_camera,
    load_system,
    read_camera,
    read_system,
    realization_from_dict,
    simulate_realization,
    system_from_mapping,
)

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
OWN = tomllib.loads((EXAMPLES / "my_system.toml").read_text(encoding="utf-8"))
MISSING = "<left out>"


def changed(document, steps, value):
    """A copy of a nested document with one entry set, or taken out."""
    document = copy.deepcopy(document)
    target = document
    for step in steps[:-1]:
        target = target[step]
    if value is MISSING:
        del target[steps[-1]]
    else:
        target[steps[-1]] = value
    return document


@pytest.mark.parametrize("name", ["my_system.toml", "my_double.json"])
def test_the_examples_of_the_docs_simulate(name):
    system = read_system(EXAMPLES / name)
    spec = Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.35, magnitude=21.0))
    observation = simulate_realization(spec).observation
    assert observation.shape == (system.exposures.field_pixels,) * 2
    assert observation.provenance["SYSTEM"] == system.name
    assert observation.provenance["CAMERA"] == system.camera_name
    assert observation.centre == system.coordinates


def test_an_own_system_is_the_same_from_toml_json_mapping_and_realization(tmp_path):
    as_json = tmp_path / "same.json"
    as_json.write_text(json.dumps(OWN), encoding="utf-8")
    system = read_system(EXAMPLES / "my_system.toml")
    assert read_system(as_json) == system_from_mapping(OWN) == system
    assert system.camera == camera_from_mapping(OWN["camera"])
    document = {"system": OWN, "l_eta": 1.0, "host": {"n": 2, "r_eff": 0.35, "magnitude": 21}}
    spec = realization_from_dict(document)
    again = realization_from_dict(json.loads(json.dumps(spec.to_dict())))
    assert again == spec
    assert again.digest == spec.digest


def test_an_own_camera_takes_the_place_of_the_systems(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(OWN["camera"]), encoding="utf-8")
    camera = read_camera(path)
    spec = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.35, magnitude=21.0), camera=camera)
    observation = simulate_realization(spec).observation
    assert observation.provenance["CAMERA"] == "my-camera"
    assert (observation.pixel_scale, observation.zero_point) == (camera.drizzled_scale, camera.zero_point)


# Where a value is wrong, what it is, how the field is told and what is allowed.
WRONG = [
    (("agn", 1, "magnitude"), "bright", "agn[1].magnitude", "a finite number"),
    (("agn", 1, "magnitude"), "19.8", "agn[1].magnitude", "a finite number"),
    (("agn", 1, "magnitude"), True, "agn[1].magnitude", "a finite number"),
    (("agn", 1, "magnitude"), math.nan, "agn[1].magnitude", "a finite number"),
    (("agn", 1, "magnitude"), math.inf, "agn[1].magnitude", "a finite number"),
    (("agn", 1, "magnitude"), 99.0, "agn[1].magnitude", "at most 40"),
    (("agn", 1, "magnitude"), MISSING, "agn[1].magnitude", "the field is required"),
    (("agn", 1, "colour"), 1.0, "agn[1].colour", "no field of this name"),
    (("agn", 0, "position"), [1.0], "agn[0].position[1]", "the field is required"),
    (("agn", 0, "position"), [1.0, 2.0, 3.0], "agn[0].position", "at most 2 entries"),
    (("agn", 0, "position", 1), 1e3, "agn[0].position[1]", "at most 60"),
    (("agn", 2, "name"), "A", "agn", "images of different names"),
    (("agn", 2, "name"), "", "agn[2].name", "at least 1 characters"),
    (("agn", 2), "A", "agn[2]", "a table of its fields"),
    (("agn",), "A", "agn", "a list"),
    (("name",), "my system", "name", "letters, digits"),
    (("name",), 7, "name", "text"),
    (("host_q",), 0.0, "host_q", "at least 0.05"),
    (("host_q",), 1.5, "host_q", "at most 1"),
    (("host_position_angle",), None, "host_position_angle", "a finite number"),
    (("coordinates",), [400.0, 0.0], "coordinates[0]", "below 360"),
    (("deflector", "n"), 20.0, "deflector.n", "at most 10"),
    (("deflector", "r_eff"), -1.0, "deflector.r_eff", "above 0.0001"),
    (("deflector",), [1], "deflector", "a table of its fields"),
    (("mass_models",), {}, "mass_models", "at least 1 entries"),
    (("mass_models",), MISSING, "mass_models", "the field is required"),
    (("mass_models", "recommended"), {}, "mass_models.recommended", "one l_eta at least"),
    (("mass_models", "recommended", "1.0", "slope"), 3.5, 'mass_models.recommended["1.0"].slope', "at most 2.8"),
    (("mass_models", "recommended", "1.0", "slope"), 2.1, 'mass_models.recommended["1.0"]', "l_eta of its slope, 1.1"),
    (("mass_models", "recommended", "1.0", "theta_E"), 0, 'mass_models.recommended["1.0"].theta_E', "above 0"),
    (("mass_models", "recommended", "0.9", "shear"), [0.1], 'mass_models.recommended["0.9"].shear[1]', "required"),
    (("exposures", "n_long"), 1.5, "exposures.n_long", "a whole number"),
    (("exposures", "n_long"), 0, "exposures.n_long", "at least 1"),
    (("exposures", "field_pixels"), 5, "exposures.field_pixels", "at least 16"),
    (("exposures", "long_s"), -1.0, "exposures.long_s", "above 0"),
    (("exposures", "dither"), 5, "exposures.dither", "a table of its fields"),
    (("exposures", "dither"), "a b", "exposures.dither", "letters, digits"),
    (("exposures", "dither", "subpixels"), 99, "exposures.dither.subpixels", "at most 12"),
    (("exposures", "dither", "shifts"), [], "exposures.dither.shifts", "at least 1 entries"),
    (("exposures", "dither", "shifts", 1, 0), 0.5, "exposures.dither.shifts[1][0]", "a whole number"),
    (("camera",), 7, "camera", "a table of its fields"),
    (("camera", "pixel_scale"), 0.0, "camera.pixel_scale", "above 0"),
    (("camera", "drizzle_kernel"), "lanczos", "camera.drizzle_kernel", "'square'"),
    (("camera", "throughput"), [1.0, 1.0], "camera.throughput", "one for each of 5 nm"),
    (("camera", "throughput"), [0.0] * 5, "camera.throughput", "positive"),
    (("camera", "wavelength_nm", 1), 100.0, "camera.wavelength_nm", "wavelengths that increase"),
    (("camera", "wavelength_nm", 1), -1.0, "camera.wavelength_nm[1]", "above 0"),
    (("camera", "detector_kernel"), [[0.0] * 3] * 3, "camera.detector_kernel", "a positive sum"),
    (("camera", "detector_kernel", 1), [1.0], "camera.detector_kernel[1][1]", "required"),
    (("camera", "read_noise_e"), -3.0, "camera.read_noise_e", "at least 0"),
    (("camera", "gain"), 0.0, "camera.gain", "above 0"),
    (("camera", "pupil", "secondary"), 1.2, "camera.pupil.secondary", "below 1"),
    (("camera", "pupil", "pads"), [[0.1, 0.2]], "camera.pupil.pads[0][2]", "required"),
    (("camera", "pupil", "primary_diameter_m"), MISSING, "camera.pupil.primary_diameter_m", "required"),
]


@pytest.mark.parametrize(("steps", "value", "field", "allowed"), WRONG, ids=lambda part: str(part)[:40])
def test_a_wrong_value_is_refused_by_its_field_with_what_is_allowed(steps, value, field, allowed):
    with pytest.raises(SpecError) as caught:
        system_from_mapping(changed(OWN, steps, value))
    assert caught.value.field == field
    assert allowed in caught.value.allowed
    assert str(caught.value).startswith(f"{field}: got ")
    # Within a realization the path goes on from its field, past the choice between a name and an object.
    with pytest.raises(SpecError) as caught:
        realization_from_dict({"system": changed(OWN, steps, value), "l_eta": 1.0, "host": {}})
    assert caught.value.field == f"system.{field}"


@pytest.mark.parametrize(
    ("steps", "value", "field"),
    [
        (("camera",), "no-such-camera", "camera"),
        (("exposures", "dither"), "no-such-dither", "dither"),
        (("agn",), OWN["agn"][:3], "agn"),
        (("mass_models", "recommended", "1.0", "source_position"), [0.5, 0.4], "agn"),
    ],
)
def test_a_system_whose_parts_do_not_fit_is_refused_when_its_file_is_read(steps, value, field, tmp_path):
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(changed(OWN, steps, value)), encoding="utf-8")
    with pytest.raises(SpecError) as caught:
        read_system(path)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("system.yaml", "name: x", "ends in .toml or .json"),
        ("system.toml", "name = ", "valid TOML"),
        ("system.json", "{", "valid JSON"),
        ("system.json", "[]", "a table of fields"),
        ("system.json", '{"name": "a", "name": "b"}', "name: got 'two values'"),
        ("system.json", "\xff", "valid JSON"),
    ],
)
def test_a_file_that_is_not_toml_or_json_is_refused(name, text, told, tmp_path):
    path = tmp_path / name
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(SpecError, match=told):
        read_system(path)


LEAVES = st.one_of(
    st.none(), st.booleans(), st.text(max_size=5), st.floats(), st.integers(), st.lists(st.integers(), max_size=2)
)


def paths(document, steps=()):
    yield steps
    if isinstance(document, dict):
        for key, value in document.items():
            yield from paths(value, (*steps, key))
    elif isinstance(document, list):
        for index, value in enumerate(document):
            yield from paths(value, (*steps, index))


@settings(max_examples=300, deadline=None)
@given(steps=st.sampled_from([steps for steps in paths(OWN) if steps]), value=LEAVES)
def test_whatever_stands_in_a_field_it_is_accepted_or_refused_by_name_and_nothing_else_happens(steps, value):
    document = changed(OWN, steps, value)
    refused = None
    try:
        system = system_from_mapping(document)
    except SpecError as error:
        refused = error.field
    # The name is that of the field, of a part of it, or of the whole that it breaks.
    if refused is not None:
        assert str(steps[0]) in refused
    else:
        assert system_from_mapping(json.loads(json.dumps(document))) == system


def test_a_grid_takes_systems_of_ones_own_beside_those_of_the_catalogue():
    own = system_from_mapping(OWN)
    grid = Grid(systems=("HE0435", own), n=(2.0,), r_eff=(0.3,), magnitude=(21.0, 22.0), l_eta=(1.0,))
    runs = expand(grid)
    assert [run.label for run in runs] == [
        f"{name}/n2_r0.3_m{m}_l1" for name in ("HE0435", "my-quad") for m in (21, 22)
    ]
    assert runs[2].realization.system == own
    assert len({run.realization.digest for run in runs}) == 4
    moved = expand(
        Grid(systems=("HE0435",), n=(2.0,), r_eff=(0.3,), magnitude=(21.0,), l_eta=(1.0,), camera=own.camera)
    )
    assert moved[0].realization.camera == own.camera


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"systems": (system_from_mapping(OWN), system_from_mapping(OWN))}, "systems"),
        ({"systems": (system_from_mapping(OWN),), "preset": "h0licow-vi"}, "systems"),
        ({"l_eta": (1.2,)}, "l_eta"),
        ({"camera": "no-such-camera"}, "camera"),
        ({"systems": (system_from_mapping(changed(OWN, ("camera",), "no-such-camera")),)}, "camera"),
        ({"systems": (system_from_mapping(changed(OWN, ("exposures", "dither"), "none")),)}, "dither"),
    ],
)
def test_a_grid_with_a_system_that_cannot_be_is_refused_by_field(changes, field):
    grid = {"systems": (system_from_mapping(OWN),), "n": (2.0,), "r_eff": (0.3,), "magnitude": (21.0,), "l_eta": (1.0,)}
    with pytest.raises(SpecError) as caught:
        expand(Grid(**{**grid, **changes}))
    assert caught.value.field == field


def test_the_specification_of_the_papers_runs_keeps_its_digest():
    # Stored results are found by these; a change of the schema must not lose them.
    runs = expand(Grid(preset="h0licow-vi"))
    assert runs[0].realization.digest == "390fdd258b5cb56c0eab4e0ec52aa1098d4c0eed6ed93550bfb63a466958296e"
    assert runs[-1].realization.digest == "fb26bb9e319856d225980613e48374983fb8361d8a319e957e4c94e3459f3135"


def test_a_system_without_agn_deflector_and_shear_simulates():
    document = {**OWN, "agn": [], "exposures": {**OWN["exposures"], "field_pixels": 40}}
    del document["deflector"], document["mass_models"]["recommended"]["1.0"]["shear"]
    spec = Realization(system=system_from_mapping(document), l_eta=1.0, host=Host(n=1.0, r_eff=0.2, magnitude=22.0))
    simulation = simulate_realization(spec)
    assert simulation.scene.agn == ()
    assert simulation.scene.deflector is None
    # Nothing but the lensed host: the noiseless exposures are its own.
    assert simulation.observation.image.sum() == pytest.approx(simulation.arc.sum(), rel=0.05)


def test_a_lens_that_makes_another_number_of_images_fails_by_field_when_it_is_run():
    wrong = system_from_mapping(changed(OWN, ("agn",), OWN["agn"][:2]))
    with pytest.raises(EngineError, match="agn"):
        simulate_realization(Realization(system=wrong, l_eta=1.0, host=Host(n=2.0, r_eff=0.35, magnitude=21.0)))


def test_the_catalogue_obeys_its_own_schema_when_written_out():
    for name in ("HE0435", "RXJ1131"):
        spec = Realization(system=load_system(name), l_eta=1.0, host=Host(n=2.0, r_eff=0.4, magnitude=21.0))
        assert system_from_mapping(spec.to_dict()["system"]) == load_system(name)
    spec = Realization(
        system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.4, magnitude=21.0), camera=load_camera("ACS-WFC_F814W")
    )
    assert camera_from_mapping(spec.to_dict()["camera"]) == load_camera("ACS-WFC_F814W")
