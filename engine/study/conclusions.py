"""What the paper concludes, line by line, and whether a study of its runs bears it out. Not numeric: a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from engine.biases import BiasPoint
from engine.study.file import Study
from engine.study.judgements import (
    ALIKE,
    INNER,
    MOST,
    NOT_STRONGLY,
    TARGET,
    Answers,
    Finding,
    Judge,
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

FAINT_ARC = 20.0
"""AB magnitude of the lensed host from which on the paper calls it faint."""
_OTHER_IR = of("HE0435", "WFI2033", "SDSS1206")
_OTHER_DOUBLES = of("SDSS0246", "HS2209")


class Statement(NamedTuple):
    """One of the paper's, in short: section, what it says, and what decides whether runs bear it out."""

    key: str
    section: str
    says: str
    judge: Judge


class Conclusion(NamedTuple):
    """A statement with what the paper's own analysis finds, and what the recommended one does."""

    statement: Statement
    paper: Finding
    recommended: Finding


def _faint(point: BiasPoint) -> bool:
    return point.arc_magnitude >= FAINT_ARC


def _quad(point: BiasPoint) -> bool:
    return point.configuration == "quad"


def _double(point: BiasPoint) -> bool:
    return point.configuration == "double"


def _brighter(limit: float) -> Judge:
    return within(lambda point: point.arc_magnitude < limit, INNER)


def _agn_over_host(point: BiasPoint) -> float | None:
    return None if point.agn_contrast is None else -point.agn_contrast


def _agn(point: BiasPoint) -> float:
    return np.inf if point.agn_contrast is None else point.arc_magnitude + point.agn_contrast


STATEMENTS: tuple[Statement, ...] = (
    Statement("i-random", "6 (i)", "Systematic errors of the host's magnitude are larger than random ones",
              above_noise(everything)),
    Statement("i-target", "6 (i)", "They are smaller than 1.25 mag, the uncertainty of a black-hole mass",
              within(everything, TARGET)),
    Statement("i-bright", "6 (i)", "They are within 0.5 mag for arcs brighter than 19 to 20", _brighter(FAINT_ARC)),
    Statement("ii-arc", "6 (ii)", "The bias depends on the magnitude of the arc", grows_with("arc_magnitude")),
    Statement("ii-contrast", "6 (ii)", "and on the contrast of arc and AGN", grows_with("agn_contrast", -1)),
    Statement("iii", "6 (iii)", "It does not depend on the host's Sersic index, 2 or 4", unmoved_by("n")),
    Statement("iv", "6 (iv)", "Quads have less bias than doubles", smaller(_quad, _double)),
    Statement("v-beyond", "6 (v)", "For arcs fainter than 20 mag it can be larger than 1.25 mag",
              beyond(_faint, TARGET)),
    Statement("v-prior", "6 (v)", "These need informative priors of shape and size (here: n fixed to the truth helps)",
              helped_by_fixed_index(_faint)),
    Statement("HE1104-errors", "4.2.1", "HE1104: stated errors are so small that they are barely seen",
              errors_below(of("HE1104"))),
    Statement("HE1104-faint", "4.2.1", "HE1104: the host comes out too faint", signed(of("HE1104"), 1)),
    Statement("HE1104-noise", "4.2.1", "HE1104: the bias is larger than the stated error", above_noise(of("HE1104"))),
    Statement("HE1104-half", "4.2.1", "HE1104: the bias is below 0.5 mag, n free or fixed",
              within(of("HE1104"), INNER, both=True)),
    Statement("HE1104-radius", "4.2.1", "HE1104: it does not depend strongly on the radius",
              unmoved_by("r_eff", of("HE1104"), NOT_STRONGLY)),
    Statement("HE1104-index", "4.2.1", "HE1104: n comes out too small", signed(of("HE1104"), -1, "n", "")),
    Statement("HE1104-hardest", "4.2.1", "HE1104 is the hardest of the four systems with WFC3-IR",
              smaller(_OTHER_IR, of("HE1104"))),
    Statement("HE1104-contrast", "4.2.1", "HE1104: its AGN outshines the host by 2 to 4 mag",
              values_within("host - AGN", _agn_over_host, of("HE1104"), 2.0, 4.0)),
    Statement("HE0435-less", "4.2.2", "HE0435 has less bias than HE1104", smaller(of("HE0435"), of("HE1104"))),
    Statement("HE0435-contrast", "4.2.2", "HE0435: host and AGN differ by -1 to 2 mag",
              values_within("host - AGN", _agn_over_host, of("HE0435"), -1.0, 2.0)),
    Statement("WFI2033", "4.2.3", "WFI2033: the bias is much smaller than 1.25 mag (here: within 0.5)",
              within(of("WFI2033"), INNER)),
    Statement("SDSS1206-magnitude", "4.2.4", "SDSS1206, a double whose host has four images, is as good as a quad",
              alike(of("SDSS1206"), _quad)),
    Statement("SDSS1206-radius", "4.2.4", "SDSS1206: in radius too",
              alike(of("SDSS1206"), _quad, "r_eff", 0.05, "arcsec")),
    Statement("SDSS1206-target", "4.2.4", "SDSS1206: the bias is smaller than 1.25 mag",
              within(of("SDSS1206"), TARGET)),
    Statement("SDSS0246-arc", "4.2.5", "SDSS0246 has the faintest arc",
              lowest_of_all("arc", lambda point: point.arc_magnitude, "SDSS0246", -1)),
    Statement("SDSS0246-bright", "4.2.5", "SDSS0246: hosts of 21.5 and 22 mag are right within 1 mag",
              within(lambda p: p.system == "SDSS0246" and p.magnitude <= 22.0, 1.0)),
    Statement("SDSS0246-worse", "4.2.5", "SDSS0246 has more bias than other systems (but HS2209)",
              smaller(lambda p: p.system not in ("SDSS0246", "HS2209"), of("SDSS0246"))),
    Statement("SDSS0246-overbright", "4.2.5", "SDSS0246: large hosts of 22.5 and 23 mag come out far too bright",
              signed(lambda p: p.system == "SDSS0246" and p.magnitude >= 22.5 and p.r_eff > 0.5, -1)),
    Statement("SDSS0246-size", "4.2.5", "SDSS0246: because their radii come out too large",
              signed(lambda p: p.system == "SDSS0246" and p.magnitude >= 22.5 and p.r_eff > 0.5, 1, "r_eff",
                     "arcsec")),
    Statement("SDSS0246-prior", "4.2.5", "SDSS0246: a radius held fixed, or below 1 arcsec, removes that",
              untested("no analysis holds the radius")),
    Statement("SDSS0246-limit", "4.2.5", "SDSS0246: hosts of 22.5 mag and fainter cannot be relied on",
              beyond(lambda p: p.system == "SDSS0246" and p.magnitude >= 22.5, TARGET, share=1.0 - MOST)),
    Statement("HS2209-agn", "4.2.6", "HS2209 has the brightest AGN, near 15 mag",
              lowest_of_all("AGN", _agn, "HS2209")),
    Statement("HS2209-worse", "4.2.6", "HS2209 has more bias than SDSS0246", smaller(of("SDSS0246"), of("HS2209"))),
    Statement("HS2209-target", "4.2.6", "HS2209: most biases are smaller than 1.25 mag",
              within(of("HS2209"), TARGET, share=0.5)),
    Statement("HE0047-doubles", "4.2.7", "HE0047 is like the doubles SDSS0246 and HS2209",
              alike(of("HE0047"), _OTHER_DOUBLES)),
    Statement("HE0047-quads", "4.2.7", "HE0047 has more bias than the quads", smaller(_quad, of("HE0047"))),
    Statement("RXJ1131-host", "4.2.8", "RXJ1131 has the brightest host",
              lowest_of_all("host", lambda point: point.magnitude, "RXJ1131")),
    Statement("RXJ1131-best", "4.2.8", "RXJ1131 has the least bias of all", smallest_of_all("RXJ1131")),
    Statement("5-bright", "5", "Arcs brighter than 19 mag are well within 0.5 mag", _brighter(19.0)),
    Statement("5-drivers", "5", "Arc and contrast matter more than the host's surface brightness",
              matters_more({"arc_magnitude": 1, "agn_contrast": -1}, "surface_brightness")),
    Statement("5-index", "5", "The boosted noise round the AGN makes n come out too small",
              signed(everything, -1, "n", "")),
    Statement("5-magnification", "5", "SDSS1206: its host is magnified by more than 3.0 mag",
              values_within("magnification", lambda p: p.magnitude - p.arc_magnitude, of("SDSS1206"), 3.0, np.inf)),
    Statement("5-earlier", "5", "HE0435, HE1104, RXJ1131: systematic errors are below 0.3 mag, those of Peng et al.",
              median_below({name: of(name) for name in ("HE0435", "HE1104", "RXJ1131")}, 0.3)),
)  # fmt: skip
"""In the order of the paper's summary, its sections on the systems, and its discussion."""


def study_conclusions(study: Study) -> tuple[Conclusion, ...]:
    """Each statement judged by the paper's analysis (n in 1-4) and by the recommended one (``image``, n in 0.3-8)."""
    paper = Answers(study.points("paper", "free"), study.points("paper", "fixed"))
    image = Answers(study.points("image", "wide"), study.points("image", "fixed"))
    return tuple(Conclusion(one, _judged(one, paper), _judged(one, image)) for one in STATEMENTS)


def _judged(statement: Statement, answers: Answers) -> Finding:
    try:
        return statement.judge(answers)
    except TooFewError as error:
        return Finding(str(error), None)


def verdict(finding: Finding) -> str:
    """What a finding says of a statement."""
    return {True: "agrees", False: "does not", None: "cannot be tested"}[finding.holds]


def conclusions_markdown(study: Study) -> str:
    """The table as a page of its own."""
    return "\n".join(_page(study))


def _page(study: Study) -> Iterator[str]:
    said = study.provenance
    cpu_s = dict(zip(study.table["run_id"].to_pylist(), study.table["cpu_s"].to_pylist(), strict=True))
    found = study_conclusions(study)
    yield "# The paper's conclusions\n"
    yield (
        f"Made by `hostlens study {said['study']} --from shipped`: {len(cpu_s)} of {said['runs_asked']} runs, profile "
        f"{_listed(said['profiles'])}, noise seeds {_listed(said['seeds'])}, engine "
        f"{_listed(digest[:12] for digest in said['engines'])}, {sum(cpu_s.values()) / 3600:.2f} hours of CPU time. "
        "`paper` is the paper's estimator with n in 1-4, `image` the recommended one with n in 0.3-8; the inversion is "
        "this engine's in both. Arcs are of each system's own filter, F160W or F814W.\n"
    )
    yield (
        f"Rules: biases are within a bound where {MOST:.0%} of them are. A median, a difference or a rank correlation "
        "has a sign where it is two of its errors (bootstrap over the runs) from zero. No difference is one below "
        f"{ALIKE:g} mag, none to speak of one below {NOT_STRONGLY:g} mag. The paper's sections on the systems are "
        "4.2.1 to 4.2.8. Each line is held by the test of its name in `tests/engine/test_conclusions.py`.\n"
    )
    for name, findings in (("paper", [one.paper for one in found]), ("image", [one.recommended for one in found])):
        agree, do_not = (sum(finding.holds is word for finding in findings) for word in (True, False))
        yield f"With `{name}` {agree} of {len(found)} lines agree, {do_not} do not.\n"
    yield "| section | the paper says | with `paper` | with `image` | line |\n|---|---|---|---|---|"
    for one in found:
        cells = [f"**{verdict(finding)}**: {finding.told}" for finding in (one.paper, one.recommended)]
        yield f"| {one.statement.section} | {one.statement.says} | {' | '.join(cells)} | `{one.statement.key}` |"
    yield ""


def _listed(values: Iterable[object]) -> str:
    return ", ".join(f"`{value}`" for value in values)
