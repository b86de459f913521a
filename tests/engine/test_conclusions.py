"""The paper's conclusions: each rule tells right from wrong, each line of the table is what the shipped file gives."""

import re
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from engine import (
    STUDY_METADATA_KEY,
    StudyError,
    conclusions_markdown,
    expand,
    read_study,
    study_conclusions,
    system_names,
    verdict,
)
from engine.grid import Grid
from engine.result import Quantity
from engine.study.conclusions import STATEMENTS
from engine.study.judgements import (
    Answers,
    TooFewError,
    above_noise,
    alike,
    beyond,
    errors_below,
    everything,
    grows_with,
    helped_by_fixed_index,
    lowest_of_all,
    matters_more,
    median_below,
    of,
    signed,
    smaller,
    smallest_of_all,
    unmoved_by,
    untested,
    values_within,
    within,
)
from tests.engine.bias_records import point

PAGE = Path(__file__).parents[2] / "docs" / "tables" / "study.md"
SHIPPED = Path(__file__).parents[2] / "engine" / "catalogue" / "h0licow_vi.parquet"
RUNS = 40


def spread(centre, width, count=RUNS, seed=0):
    return np.random.default_rng(seed).normal(centre, width, count)


def runs(biases, sd=0.05, **given):
    """Runs with these biases of the magnitude; any field may be one value or one for each."""
    return [
        point(
            float(bias), sd, run_id=f"r{k}", **{name: v[k] if isinstance(v, list) else v for name, v in given.items()}
        )
        for k, bias in enumerate(biases)
    ]


def judged(judge, free, fixed=()):
    return judge(Answers(free, fixed)).holds


ARCS = [18.0 + 0.1 * k for k in range(RUNS)]
FLAT = spread(0.0, 0.3)
RISING = [0.05 * k * (-1) ** k for k in range(RUNS)]
"""Sizes that grow with the number of the run."""
OTHER = [21.0 + 0.2 * (k * 7 % RUNS) for k in range(RUNS)]
CASES = {
    "within": (within(everything, 0.5), runs(spread(0.0, 0.1)), runs(spread(0.4, 0.3))),
    "within a larger share": (within(everything, 0.5, share=0.5), runs([0.1] * 6 + [0.9] * 4), runs([0.1, 0.9, 0.9])),
    "beyond": (beyond(everything, 1.25), runs([0.1] * 9 + [-1.3]), runs([0.1] * 9 + [-1.2])),
    "beyond a share": (beyond(everything, 1.25, share=0.1), runs([1.3] * 2 + [0.0] * 8), runs([1.3] + [0.0] * 9)),
    "above noise": (above_noise(everything), runs(spread(0.5, 0.1)), runs(spread(0.0, 0.05))),
    "errors below": (errors_below(everything), runs([0.0] * 4, 0.05), runs([0.0] * 4, 0.2)),
    "median below": (median_below({"a": everything}, 0.3), runs([0.2, -0.2, 0.9]), runs([0.4, -0.4, 0.1])),
    "signed": (signed(everything, 1), runs(spread(0.2, 0.1)), runs(spread(0.0, 0.1))),
    "signed in n": (signed(everything, -1, "n", ""), runs(spread(-0.2, 0.1)), runs(spread(0.2, 0.1))),
    "smaller": (
        smaller(of("A"), of("B")),
        runs(spread(0.1, 0.02), system="A") + runs(spread(-0.4, 0.05), system="B"),
        runs(spread(0.1, 0.02), system="A") + runs(spread(-0.1, 0.02), system="B"),
    ),
    "alike": (
        alike(of("A"), of("B")),
        runs(spread(0.3, 0.1), system="A") + runs(spread(-0.2, 0.1), system="B"),
        runs(spread(0.8, 0.1), system="A") + runs(spread(0.2, 0.1), system="B"),
    ),
    "unmoved by an input": (
        unmoved_by("n"),
        runs([0.1, 0.15, 0.3, 0.32], n=[2.0, 4.0, 2.0, 4.0], magnitude=[21.0, 21.0, 22.0, 22.0]),
        runs([0.1, 0.25, 0.3, 0.42], n=[2.0, 4.0, 2.0, 4.0], magnitude=[21.0, 21.0, 22.0, 22.0]),
    ),
    "grows with": (grows_with("arc_magnitude"), runs(RISING, arc_magnitude=ARCS), runs(FLAT, arc_magnitude=ARCS)),
    "falls with": (
        grows_with("agn_contrast", -1),
        runs(RISING, agn_contrast=[-0.1 * k for k in range(RUNS)]),
        runs(RISING, agn_contrast=[0.1 * k for k in range(RUNS)]),
    ),
    "matters more": (
        matters_more({"arc_magnitude": 1}, "surface_brightness"),
        runs(RISING, arc_magnitude=ARCS, surface_brightness=OTHER),
        runs(RISING, arc_magnitude=OTHER, surface_brightness=ARCS),
    ),
    "smallest of all": (
        smallest_of_all("A"),
        runs([0.1, -0.1], system="A") + runs([0.2, -0.3], system="B") + runs([0.4, 0.4], system="C"),
        runs([0.1, -0.3], system="A") + runs([0.2, -0.3], system="B") + runs([0.1, 0.1], system="C"),
    ),
    "values within": (
        values_within("arc", lambda p: p.arc_magnitude, everything, 18.0, 20.0),
        runs([0.0] * 10, arc_magnitude=[18.0] * 9 + [21.0]),
        runs([0.0] * 10, arc_magnitude=[18.0] * 8 + [21.0] * 2),
    ),
    "lowest of all": (
        lowest_of_all("arc", lambda p: p.arc_magnitude, "A"),
        runs([0.0] * 4, system=["A", "A", "B", "B"], arc_magnitude=[18.0, 18.5, 19.0, 19.0]),
        runs([0.0] * 4, system=["A", "A", "B", "B"], arc_magnitude=[19.0, 19.5, 18.0, 19.0]),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_rule_holds_of_runs_that_are_so_and_not_of_runs_that_are_not(name):
    judge, so, not_so = CASES[name]
    assert judged(judge, so) is True
    assert judged(judge, not_so) is False


def test_a_fixed_index_helps_where_it_makes_biases_smaller():
    free, fixed = runs(spread(0.6, 0.1)), runs(spread(0.2, 0.1), index_prior="fixed")
    assert judged(helped_by_fixed_index(everything), free, fixed) is True
    assert judged(helped_by_fixed_index(everything), free, free) is False
    both = within(everything, 0.5, both=True)
    assert judged(both, runs([0.1] * 5), runs([0.1] * 5)) is True
    assert judged(both, runs([0.1] * 5), runs([0.9] * 5)) is False


def test_a_median_has_the_standard_error_that_repetition_finds():
    # Of a normal distribution that of a median is 1.2533 sd / sqrt(N); the bootstrap is right to a tenth at N = 400.
    told = signed(everything, 1)(Answers(runs(spread(0.0, 1.0, 400)), ())).told
    error = float(re.search(r"± (\d\.\d+) mag", told)[1])
    assert error == pytest.approx(1.2533 / 20.0, rel=0.25)


def test_what_the_runs_cannot_say_is_not_said():
    for judge in (above_noise(of("nothing")), smaller(everything, of("nothing")), smallest_of_all("HE1104")):
        with pytest.raises(TooFewError):
            judge(Answers(runs([0.1, 0.2]), ()))
    with pytest.raises(TooFewError, match="do not differ"):
        grows_with("arc_magnitude")(Answers(runs([0.1, 0.2]), ()))
    assert untested("nobody asked")(Answers((), ())) == ("nobody asked", None)


@pytest.fixture(scope="module")
def shipped():
    return read_study()


@pytest.fixture(scope="module")
def lines(shipped):
    return {one.statement.key: one for one in study_conclusions(shipped)}


@pytest.mark.parametrize("key", [one.key for one in STATEMENTS])
def test_line(key, lines):
    """The line of the documentation is what the shipped file gives."""
    (row,) = [line for line in PAGE.read_text().splitlines() if line.endswith(f"| `{key}` |")]
    _, section, says, paper, recommended, _, _ = [cell.strip() for cell in row.split("|")]
    one = lines[key]
    assert (section, says) == (one.statement.section, one.statement.says)
    for cell, finding in ((paper, one.paper), (recommended, one.recommended)):
        assert cell == f"**{verdict(finding)}**: {finding.told}"


def test_the_page_is_that_of_the_shipped_file(shipped):
    assert PAGE.read_text() == conclusions_markdown(shipped), "hostlens study h0licow-vi --from shipped"


def test_the_shipped_file_is_of_the_papers_runs_and_small(shipped):
    asked = {(one.realization.system_name, one.paper_run): one.realization for one in expand(Grid(preset="h0licow-vi"))}
    for row in shipped.table.select(["system", "paper_run", "n", "r_eff", "magnitude", "l_eta"]).to_pylist():
        realization = asked[row["system"], row["paper_run"]]
        host = realization.host
        assert (row["n"], row["r_eff"], row["magnitude"]) == (host.n, host.r_eff, host.magnitude)
        assert row["l_eta"] == realization.l_eta
    said = shipped.provenance
    assert set(said["engines"]) == set(shipped.table["engine_digest"].to_pylist())
    assert said["runs"] == len(set(shipped.table["run_id"].to_pylist()))
    # Each run has four estimators with three priors of n, but for answers that there are none.
    assert shipped.table.num_rows == pytest.approx(12 * said["runs"], rel=0.01)
    # A few hundred kB for each noise seed.
    assert SHIPPED.stat().st_size < 400_000 * len(said["seeds"])


def test_points_of_a_study_are_its_rows(shipped):
    points = shipped.points("paper", "free")
    assert {p.index_prior for p in points} == {"free"}
    row = next(r for r in shipped.table.to_pylist() if (r["estimator"], r["index_prior"]) == ("paper", "free"))
    first = next(p for p in points if p.run_id == row["run_id"])
    # Biases have the seven digits of single precision.
    assert first.bias("magnitude") == pytest.approx(row["magnitude_bias"], abs=1e-6)
    assert first.recovered["r_eff"] == Quantity(row["r_eff"] + row["r_eff_bias"], row["r_eff_sd"], row["r_eff"])
    whole = shipped.points("image", "wide", "fixed")
    assert len(whole) == len(shipped.points("image", "wide")) + len(shipped.points("image", "fixed"))


def test_a_file_that_is_no_study_is_refused(tmp_path):
    other = tmp_path / "other.parquet"
    other.write_bytes(b"PAR1")
    with pytest.raises(StudyError, match="is no Parquet file"):
        read_study(other)
    parquet.write_table(pyarrow.table({"a": [1]}), other)
    with pytest.raises(StudyError, match="format None"):
        read_study(other)
    newer = pyarrow.table({"a": [1]}).replace_schema_metadata({STUDY_METADATA_KEY: '{"format": "hostlens study 2"}'})
    parquet.write_table(newer, other)
    with pytest.raises(StudyError, match="hostlens study 2"):
        read_study(other)


@pytest.mark.parametrize("system", system_names())
def test_a_statement_judges_the_system_that_it_names(system, shipped):
    others = Answers(
        *([p for p in shipped.points("image", prior) if p.system != system] for prior in ("wide", "fixed"))
    )
    named = [one for one in STATEMENTS if one.key.startswith(system) and one.key != "SDSS0246-prior"]
    assert named
    for one in named:
        with pytest.raises(TooFewError):
            one.judge(others)
