"""`vesselflow advise`: its errors on pours that are known, its choice, and its reasons."""

import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from app.cli import cli, invoke
from app.files import read_rows
from app.scenes.library import find_scene
from app.studies import advise as study
from app.studies.advise import (
    DEFAULT,
    EVIDENCE,
    MEASURES,
    PROBED,
    Advice,
    Candidate,
    Probe,
    advisable,
    candidates,
    check_advice,
    choose,
    expected,
    ratio,
    survival,
    yield_sentence,
)
from app.studies.chart import Row
from app.studies.methods import METHODS, SOFT, Method
from app.studies.stability import Row as StabilityRow
from app.studies.timed_run import Trace
from chart_rows import ROW
from taichi_sph.errors import InputError, RunError

RISE = 0.2
POURED = [m for m in METHODS if m.curve in PROBED]
PCNET = next(m for m in METHODS if m.name == "pcnet")
SCENE = find_scene("aortoiliac")


def poured(method: Method, died: str = "") -> Probe:
    """A pour whose kinetic energy rises with the spacing by RISE of that at spacing 1."""
    frames = 4
    trace = Trace(
        0.01,
        drained=[0.0] * frames,
        centre=[np.array([0.0, 0.0, -0.1 * k]) for k in range(frames)],
        energy=[1.0 + RISE * (method.spacing - 1.0)] * frames,
        compression=[0.02] * frames,
        slow=[0.25] * frames,
    )
    return Probe(method, 1e-3, 500, 0.04, died, 0.01, 100.0 / method.spacing**4, trace)


def charted(**deaths: str) -> list[Row]:
    """A chart on which the physics costs four times as much and is off twice as far."""
    return [
        replace(
            ROW,
            scene=scene,
            method=method.name,
            curve=method.curve,
            wall_per_simulated=400.0 if method.model == "physics" else 100.0,
            energy=0.06 if method.model == "physics" else 0.03,
            died=deaths.get(method.name, ""),
        )
        for scene in ("one", "two")
        for method in METHODS
    ]


def runs(name: str, deaths: int, case: str = "low column") -> list[StabilityRow]:
    """Twenty starts of a method in a case."""
    return [
        StabilityRow(name, case, k, 1.0, "dead" if k < deaths else "", 0, 0.0, 0.0, 0, 0.0)
        for k in range(20)
    ]


LONG = ("pcnet", "implicit, 0 rounds")
SAFE = [t for name in ("physics", *LONG) for t in runs(name, 0)]


def test_errors_of_first_order_are_found():
    """C s: C (s - 1) is seen, C/2 is that of spacing 1, and a coarser one has both."""
    found = expected({s: 0.3 * (s - 1.0) for s in (1.25, 1.5, 2.0)})
    assert found[1.0] == pytest.approx(0.15)
    assert found[2.0] == pytest.approx(math.hypot(0.3, 0.15))
    assert math.isnan(expected({})[1.0])
    assert expected({1.25: 0.07})[1.0] == pytest.approx(0.14)


def test_what_a_method_is_to_another_is_a_mean_over_scenes():
    """sqrt(2 x 8) = 4; a scene without an error, or with a death, says nothing."""
    rows = [
        replace(ROW, scene=scene, method=name, energy=energy, died=died)
        for scene, name, energy, died in (
            ("one", "mine", 0.02, ""), ("one", "base", 0.01, ""),
            ("two", "mine", 0.08, ""), ("two", "base", 0.01, ""),
            ("three", "mine", 0.0, ""), ("three", "base", 0.0, ""),
            ("four", "mine", 0.9, ""), ("four", "base", 0.01, "it leaked"),
        )
    ]  # fmt: skip
    assert ratio(rows, [Method("mine", "")], {1.0: "base"}, "energy") == pytest.approx(4.0)
    assert math.isnan(ratio(rows, [Method("nobody", "")], {1.0: "base"}, "energy"))


def by_name(
    probes: list[Probe], rows: list[Row], cases: list[StabilityRow]
) -> dict[str, Candidate]:
    """What is listed, by name, by the kinetic energy."""
    return {c.method.name: c for c in candidates(probes, rows, cases, ("energy",))}


def test_errors_and_costs_of_candidates_follow_from_pours_and_chart():
    """RISE (s - 1) beside spacing 1, whose own is RISE/2; the physics at four times the cost."""
    found = by_name([*map(poured, POURED)], charted(), SAFE)
    for method in POURED:
        error = RISE * math.hypot(method.spacing - 1.0, 0.5)
        assert found[method.name].error == pytest.approx(error)
        cost = poured(method).wall_per_simulated
        assert found[method.name].wall_per_simulated == cost
        if method.model == "implicit":
            other = found[method.name.replace("implicit, 0 rounds", "physics")]
            assert other.error == pytest.approx(2.0 * error)  # as on the chart
            assert other.wall_per_simulated == pytest.approx(4.0 * cost)


def test_a_vessel_that_bears_no_coarser_spacing_has_the_errors_of_the_chart():
    alone = [poured(method) for method in POURED if method.spacing == 1.0]
    found = by_name(alone, charted(), SAFE)
    assert found["pcnet"].error == 0.03
    assert "pcnet, 2 d" not in found


def test_what_died_is_not_advised():
    rows = charted(**{"physics, 2 d": "compressed by 11 %"})
    probes = [poured(m, "it leaked" if m.name == "pcnet, 2 d" else "") for m in POURED]
    found = by_name(probes, rows, SAFE)
    *costs, unknown = (c.wall_per_simulated for c in found.values())
    assert math.isnan(unknown)  # of "physics, 2 d", whose death has no cost: it stands last
    assert costs == sorted(costs)
    assert found["pcnet, 2 d"].rejected_because == "died here: it leaked"
    assert "compressed by 11 %" in found["physics, 2 d"].rejected_because
    assert found["pcnet"].rejected_because == ""
    assert found[SOFT.name].rejected_because.startswith("lived through 0 of 0 starts")
    dying = [t for t in SAFE if t.method != "pcnet"] + runs("pcnet", 2)
    found = by_name(probes, rows, dying)
    assert (
        found["pcnet"].rejected_because
        == "lived through 18 of 20 starts that the physics lives through"
    )


def test_only_cases_that_the_physics_lives_through_count():
    hard = runs("physics", 20, "high column") + runs("pcnet", 20, "high column")
    steps = runs("physics", 0, "step x 2") + runs("pcnet", 20, "step x 2")
    assert survival([*SAFE, *hard, *steps], PCNET) == (20, 20)


def candidate(name: str, wall: float, error: float, rejected_because: str = "") -> Candidate:
    """One with a name."""
    return Candidate(Method(name, ""), error, wall, rejected_because)


@pytest.mark.parametrize(
    ("error", "slowest", "chosen"),
    [
        (0.05, math.inf, "fair"),
        (0.10, math.inf, "coarse"),
        (0.02, math.inf, "exact"),
        (0.01, math.inf, "exact"),  # none is within: the most exact
        (0.02, 30.0, "fair"),  # none is both: the most exact that is quick enough
        (0.05, 1.0, "fair"),  # none is quick enough: the cheapest within the error
    ],
)
def test_the_cheapest_that_will_do_is_chosen(error: float, slowest: float, chosen: str):
    found = [
        candidate("dead", 1.0, 0.001, "died"),
        candidate("coarse", 10.0, 0.08),
        candidate("fair", 20.0, 0.04),
        candidate("poor", 25.0, 0.05),
        candidate("exact", 90.0, 0.02),
    ]
    assert choose(found, error, slowest).method.name == chosen


def test_nothing_fit_is_said():
    with pytest.raises(RunError, match="no listed method"):
        choose([candidate("dead", 1.0, 0.0, "died")], 1.0, math.inf)


def test_casson_by_the_stress_at_the_wall():
    """tau_w = 1060 x 9.81 x 0.01 / 4 = 26 Pa: b = 1.92e-4, 16/7 b^1/2 = 3.17 %."""
    sentence = yield_sentence(SCENE, 0.01)
    assert "matters little" in sentence
    assert "0.019 %" in sentence
    assert "3.1 %" in sentence
    still = msgspec.structs.replace(SCENE, gravity=(0.0, 0.0, -0.01))
    assert "law matters:" in yield_sentence(still, 0.01)


def test_what_dies_when_it_is_poured_gives_way(monkeypatch: pytest.MonkeyPatch):
    """The chart has a cheap method that was not poured: it is, and dies, and the next is taken."""
    asked = []

    def stand_in(work, job):
        asked.append(job.method.name)
        return poured(job.method, "it leaked" if job.method.model == "physics" else "")

    cheap = [replace(r, wall_per_simulated=1.0) if r.method == "physics" else r for r in charted()]
    monkeypatch.setattr(study, "in_own_process", stand_in)
    monkeypatch.setattr(study, "read_rows", lambda path, row: cheap if row is Row else SAFE)
    advice = study.advise(SCENE, 0.21, ("energy",), None, 0.5, "cpu", None)
    assert asked == [*(m.name for m in sorted(POURED, key=lambda m: -m.spacing)), "physics"]
    assert advice.method.spacing == 1.5  # RISE hypot(1/2, 1/2) = 0.14; at 2 it is 0.22
    assert "Cheaper, but not advised: physics (died here: it leaked)." in advice.text
    assert "25 % of the blood is at rest" in advice.text


def still(method: Method) -> Probe:
    """A run whose blood stays where it is, but for a tenth of a spacing."""
    probe = poured(method)
    centre = [np.array([0.0, 0.0, -1e-4 * (k % 2)]) for k in range(4)]
    return replace(probe, trace=replace(probe.trace, spacing=1e-3, centre=centre))


def test_of_blood_at_rest_only_the_drained_part_is_judged(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(study, "in_own_process", lambda work, job: still(job.method))
    monkeypatch.setattr(study, "read_rows", lambda path, row: charted() if row is Row else SAFE)
    advice = study.advise(SCENE, 0.1, DEFAULT, None, 0.5, "cpu", None)
    assert "The blood stays where it is" in advice.text
    assert "kinetic energy off by" not in advice.text
    with pytest.raises(InputError, match=r"stays where it is for 0\.5 s, so nothing can be said"):
        study.advise(SCENE, 0.1, ("energy", "field"), None, 0.5, "cpu", None)


def test_no_figure_that_is_not_there_is_shown(monkeypatch: pytest.MonkeyPatch):
    """The cost of a method that died on the chart is not known."""
    rows = charted(**{"physics, 2 d": "compressed by 11 %"})
    monkeypatch.setattr(study, "in_own_process", lambda work, job: poured(job.method))
    monkeypatch.setattr(study, "read_rows", lambda path, row: rows if row is Row else SAFE)
    advice = study.advise(SCENE, 0.21, ("energy",), None, 0.5, "cpu", None)
    assert any(math.isnan(c.wall_per_simulated) for c in advice.candidates)
    cells = [c for column in study.candidates_table(SCENE, advice).columns for c in column.cells]
    assert "-" in cells
    assert not any("nan" in str(c) for c in cells) and "nan" not in advice.text


def test_what_is_not_safe_is_not_poured(monkeypatch: pytest.MonkeyPatch):
    asked = []

    def stand_in(work, job):
        asked.append(job.method.name)
        return poured(job.method)

    dying = [t for t in SAFE if t.method != "pcnet"] + runs("pcnet", 2)
    monkeypatch.setattr(study, "in_own_process", stand_in)
    monkeypatch.setattr(study, "read_rows", lambda path, row: charted() if row is Row else dying)
    advice = study.advise(SCENE, 0.21, ("energy",), None, 0.5, "cpu", None)
    assert not any("pcnet" in name for name in asked)
    assert "pcnet" not in advice.method.name
    assert any(c.method.name == "pcnet" and c.rejected_because for c in advice.candidates)


def test_the_evidence_has_every_listed_method():
    """What comes with the program is of the methods that it lists."""
    rows = read_rows(EVIDENCE / "chart.csv", Row)
    cases = read_rows(EVIDENCE / "stability.csv", StabilityRow)
    assert {row.method for row in rows} >= {m.name for m in advisable()}
    for method in advisable():
        assert survival(cases, method)[1] > 0, method.name
    assert {"pcnet", "implicit", "physics"} <= {m.name for m in advisable()}


def test_the_command_offers_what_there_is_and_refuses_too_short_a_time():
    offered = next(p for p in cli.commands["advise"].params if p.name == "measures")
    assert list(getattr(offered.type, "choices", ())) == list(MEASURES)
    assert offered.default == DEFAULT
    message, code = invoke(["advise", "tube", "--until", "0.001"])
    assert code == 2
    assert "--until 0.001" in message


@pytest.mark.validation
def test_a_run_takes_what_is_advised(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The model and its spacing: at twice the spacing an eighth of the blood."""
    asked: dict[str, float] = {}

    def stand_in(scene, error, measures, real_time, until, arch, threads):
        asked.update(error=error, until=until)
        return Advice(next(m for m in POURED if m.spacing == 2.0), [], "because")

    monkeypatch.setattr(study, "advise", stand_in)
    monkeypatch.setattr("taichi_sph.runtime.start", lambda *_, **__: None)
    told = tmp_path / "summary.json"
    text = ["run", "box", "--frames", "2", "--model", "auto", "--error", "0.3", "--summary", told]
    message, code = invoke([str(part) for part in text])
    assert (message, code) == ("", 0)
    assert "because" in capsys.readouterr().err
    assert asked == {"error": 0.3, "until": pytest.approx(2 * find_scene("box").frame_interval)}
    summary = json.loads(told.read_text())
    assert summary["model"] == "implicit"
    assert summary["blood_particles"] == 5120 // 8


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("fair", 0.05, "is off by 4 %, within the budget; no cheaper one that is fit"),
        ("exact", 0.05, "cheaper and within it: fair (4 %, 4.5 times cheaper)"),
        ("coarse", 0.05, "is off by 8 %, beyond the budget; no cheaper one"),
        ("dead", 0.05, "dead died: it leaked"),
    ],
)
def test_advice_is_checked(name: str, error: float, said: str, monkeypatch: pytest.MonkeyPatch):
    found = [
        candidate("dead", 1.0, 0.0),
        candidate("unsafe", 5.0, 0.01, "lived through 1 of 9"),
        candidate("coarse", 10.0, 0.08),
        candidate("fair", 20.0, 0.04),
        candidate("exact", 90.0, 0.02),
    ]
    rows = [
        replace(
            ROW, scene=SCENE.name, until=0.1, method=c.method.name, energy=c.error, drained=0.0,
            wall_per_simulated=c.wall_per_simulated,
            died="it leaked" if c.method.name == "dead" else "",
        )
        for c in found
    ]  # fmt: skip
    # What is not listed does not count.
    rows.append(replace(rows[0], method="floor", died=""))
    monkeypatch.setattr(study, "main", lambda *_: rows)
    advice = Advice(Method(name, ""), found, "")
    assert said in check_advice(SCENE, advice, error, DEFAULT, 0.1, Path("x"), "cpu", None)
