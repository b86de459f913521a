"""The command ``hostlens measure``: what it refuses, what it writes, and that it writes nothing when it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner

from engine import Host, Realization, simulate_realization, write_observation
from service.cli.app import app

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One simulated image as our own FITS file and in the parts that other people hand over."""
    folder = tmp_path_factory.mktemp("measure")
    host = Host(n=2.0, r_eff=0.39, magnitude=20.5)
    seen = simulate_realization(Realization(system="HE0435", l_eta=1.0, host=host)).observation
    out = {name: folder / f"{name}.fits" for name in ("own", "image", "noise", "psf", "broken")}
    write_observation(out["own"], seen)
    fits.writeto(out["image"], seen.image)
    fits.writeto(out["noise"], seen.noise)
    # As others have it: padded, so that the peak is off the middle, and not normalised.
    fits.writeto(out["psf"], 3.0 * np.pad(seen.psf, ((0, 4), (0, 6))))
    out["broken"].write_text("not FITS")
    return out


def _run(*arguments: object) -> tuple[int, str]:
    result = RUNNER.invoke(app, ["measure", *map(str, arguments)], env={"COLUMNS": "200"})
    return result.exit_code, result.output + (result.stderr if result.stderr_bytes is not None else "")


@pytest.fixture(scope="module")
def measured(files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out")
    code, output = _run(
        files["image"], "--noise", files["noise"], "--psf", files["psf"], "--pixel-scale", "0.08",
        "--zeropoint", "25.9463", "--theta-e", "1.2", "--agn-images", 4, "--no-shear", "--no-inversion",
        "--json", folder / "out.json", "--figure", folder / "out.png", "--fits", folder / "out.fits",
    )  # fmt: skip
    assert code == 0, output
    return folder


def test_an_image_in_parts_is_measured_and_written(measured: Path) -> None:
    document = json.loads((measured / "out.json").read_text())
    # Where everything was read, and what was assumed, is in the answer.
    read = {entry["name"]: (entry["value"], entry["origin"]) for entry in document["read"]}
    assert read["noise"] == ("1 sigma", "noise.fits[0]")
    assert read["zero_point"] == (25.9463, "--zeropoint")
    assert read["unit"] == ("e-/s", "assumed: there is no BUNIT")
    assert read["north"][1].startswith("assumed")
    assert document["on_sky"]["image"] == {"north": 0.0, "east": "left of North"}
    assert len(document["on_sky"]["agn"]) == len(document["agn"])
    assert document["on_sky"]["agn"][0]["east"] == pytest.approx(-document["agn"][0]["x"])
    host = document["host"]["magnitude"]
    # Without the exposures behind the image its AGN are shifted stamps: the errors that it gives must cover that.
    assert host["mean"] == pytest.approx(20.5, abs=3 * host["sd"])
    assert document["lens"]["theta_E"]["mean"] == pytest.approx(1.2171, abs=5e-3)
    assert document["profile"] == "standard"
    assert sorted(path.name for path in measured.iterdir()) == ["out.fits", "out.json", "out.png"]
    assert (measured / "out.png").read_bytes().startswith(b"\x89PNG")


PARTS = ("--pixel-scale", "0.08", "--zeropoint", "25.9")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("missing.fits", "--psf", "{psf}", *PARTS), "missing.fits"),
        (("{broken}", "--psf", "{psf}", *PARTS), "not a FITS file"),
        (("{broken}",), "not a FITS file"),
        (("{image}", *PARTS), "--psf"),
        (("{image}", "--psf", "{psf}", "--pixel-scale", "0.08", "--exposure", "100"), "zero_point must be given"),
        (("{image}", "--noise", "{noise}", "--psf", "{psf}", "--zeropoint", "25.9"), "pixel_scale"),
        (("{image}", "--psf", "{psf}", *PARTS), "exposure"),
        (("{image}", "--noise", "{psf}", "--psf", "{psf}", *PARTS), "noise"),
        (("{own}", "--profile", "best"), "profile"),
        (("{own}", "--no-agn", "--agn-images", "2"), "--no-agn"),
        (("{own}", "--positions", "1;2"), "--positions"),
        (("{own}", "--theta-e", "-1"), "theta_E"),
        (("{own}", "--zeropoint", "25.9", "--exposure", "9"), "leave out --zeropoint, --exposure"),
        (("{image}", "--psf", "{psf}", "--unit", "mJy", *PARTS), "--unit"),
        (("{own}", "--figure", "/no/such/folder/a.png"), "folder"),
    ],
)
def test_bad_input_is_named_with_exit_code_2_and_nothing_is_written(
    files: dict[str, Path], tmp_path: Path, arguments: tuple[str, ...], complaint: str
) -> None:
    given = [argument.format(**{name: str(path) for name, path in files.items()}) for argument in arguments]
    code, output = _run(*given, "--json", tmp_path / "out.json")
    assert code == 2, output
    assert complaint in output
    assert not list(tmp_path.iterdir())


def test_what_was_read_is_told_before_the_fit(files: dict[str, Path], tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    header = fits.Header({"BUNIT": "ELECTRONS", "EXPTIME": 100.0, "ABMAG": 25.5, "PIXSCALE": 0.08})
    fits.writeto(tmp_path / "noise_alone.fits", rng.standard_normal((60, 60)), header)
    code, output = _run(tmp_path / "noise_alone.fits", "--psf", files["psf"], "--json", tmp_path / "out.json")
    # Noise alone is told to be that, in seconds, and nothing is written.
    assert code == 2, output
    assert "nothing stands out of its noise" in output
    for line in (
        "read.unit         ELECTRONS  (BUNIT of noise_alone.fits[0])",
        "read.exposure_s   100  (EXPTIME of noise_alone.fits[0])",
        "read.zero_point   25.5  (ABMAG of noise_alone.fits[0])",
        "read.pixel_scale  0.08  (PIXSCALE of noise_alone.fits[0])",
        "read.noise        made from the image  (noise_alone.fits[0])",
    ):
        assert line in output
    assert not (tmp_path / "out.json").exists()


def test_an_output_that_fails_does_not_take_the_others_with_it(
    monkeypatch: pytest.MonkeyPatch, files: dict[str, Path], tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("engine.measurement_files.write_measurement", full)
    code, output = _run(
        files["own"], "--agn-images", 4, "--no-shear", "--theta-e", "1.2", "--no-inversion",
        "--fits", tmp_path / "out.fits", "--json", tmp_path / "out.json",
    )  # fmt: skip
    assert code == 1, output
    assert "host.magnitude" in output
    assert f"{tmp_path / 'out.fits'}: not written ([Errno 28] No space left on device)" in output
    assert json.loads((tmp_path / "out.json").read_text())["status"] == "ok"
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--theta-e", "nan"), "theta_E"),
        (("--positions", "nan,1"), "positions"),
        (("--size", "nan"), "size"),
        (("--center", "1", "-2"), "size"),
        (("--center", "x", "y", "--size", "3"), "center"),
        (("--zeropoint", "1e6"), "zero_point"),
        (("--extension", "7"), "extension"),
        (("--good-bits", "1", "--dq", "{noise}"), "dq"),
    ],
)
def test_options_that_are_no_numbers_or_do_not_go_together_are_one_line(
    files: dict[str, Path], arguments: tuple[str, ...], complaint: str
) -> None:
    given = [argument.format(**{name: str(path) for name, path in files.items()}) for argument in arguments]
    code, output = _run(files["image"], "--noise", files["noise"], "--psf", files["psf"], *PARTS, *given)
    assert code == 2, output
    (line,) = {line for line in output.splitlines() if line.startswith("hostlens")}
    assert complaint in line
