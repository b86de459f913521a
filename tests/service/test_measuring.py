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
