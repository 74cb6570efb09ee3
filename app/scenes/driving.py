"""What drives the blood of a scene, in words, and what no vessel has.

A wrong unit in an inflow runs without complaint and gives a steady or an absurd flow.  Each bound
here is beyond what is known of people, so that a question is worth its reader's time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_sph.scene import OpeningTable, Scene
from taichi_sph.waveform import STEADY, Waveform, read_waveform

if TYPE_CHECKING:
    from taichi_sph.geometry.vessel import Vessel

LONGEST_PERIOD = 20.0
"""Slower than any heart beat or breath [s]."""
SHORTEST_PERIOD = 0.1
"""A mouse's heart beats ten times a second, a person's four at the most [s]."""
FASTEST = 5.0
"""Speed through an opening [m/s]: a jet behind a narrow aortic valve (4 m/s is called severe)."""
SLOWEST = 1e-4
"""Speed through an opening [m/s]: a fifth of that in a capillary."""
HIGHEST_PRESSURE = 4e4
"""300 mmHg [Pa]: no artery has more."""
LOWEST_PRESSURE = -1.3e4
"""-100 mmHg [Pa]: a strong suction pump's."""
LARGEST_MEAN_FACTOR = 5.0
"""A waveform is a factor, of mean or largest value about 1."""
SMALLEST_FACTOR = 0.1
NO_MEAN = 1e-3
"""A mean below this part of the largest value is none."""
MMHG = 133.322
"""[Pa]"""


@dataclass(frozen=True)
class Drive:
    """What drives blood through an opening, or moves the wall."""

    name: str
    """Of the opening; "wall"."""
    text: str
    """What it is, in SI units."""
    questions: tuple[str, ...]
    """What is likely to be a mistake, a sentence each."""

    def lines(self) -> Iterator[str]:
        """All of it, a line each."""
        yield f"{self.name}: {self.text}"
        for question in self.questions:
            yield f"note: {self.name}: {question}"


def driving(scene: Scene, vessel: "Vessel") -> list[Drive]:
    """What drives the blood of a scene, opening by opening.

    Raises:
        InputError: a waveform cannot be read.
    """
    waves = {
        name: read_waveform(table.waveform, Path(scene.folder))
        for name, table in scene.openings.items()
        if table.driven
    }
    area = {opening.name: opening.area for opening in vessel.openings}
    fills = any(
        (scene.openings[name].flow or 0.0) * wave.mean > 0.0 for name, wave in waves.items()
    )
    found = []
    for name, wave in waves.items():
        table = scene.openings[name]
        if table.flow is not None:
            found.append(_pump(name, table, table.flow, wave, area[name], fills))
        else:
            found.append(_reservoir(name, table, table.pressure or 0.0, wave))
    if scene.wall is not None:
        wave = read_waveform(scene.wall.waveform, Path(scene.folder))
        text = f"moves out by {scene.wall.pulse:.3g} m, period {wave.period:.3g} s"
        found.append(Drive("wall", text, tuple(_doubts_of_period(wave, scene.wall.waveform))))
    return found


def _pump(
    name: str, table: OpeningTable, flow: float, wave: Waveform, area: float, fills: bool
) -> Drive:
    mean, least, most = flow * wave.mean, *sorted((flow * wave.least, flow * wave.most))
    peak = max(abs(least), abs(most))
    speed = peak / area
    questions = [*_doubts_of_period(wave, table.waveform), *_doubts_of_factor(wave, table.waveform)]
    if speed > FASTEST:
        questions.append(
            f"{speed:.3g} m/s through the opening is faster than blood flows anywhere; "
            "is the flow in m^3/s (1 ml/s is 1e-6)?"
        )
    elif 0.0 < speed < SLOWEST:
        questions.append(
            f"{speed:.3g} m/s through the opening at most is next to nothing; is the flow in "
            "m^3/s (1 ml/s is 1e-6), and the waveform a factor?"
        )
    if peak > 0.0 and abs(mean) < NO_MEAN * peak:
        questions.append("its mean is zero: on average nothing flows")
    elif mean < 0.0 and not fills:
        questions.append(
            "its mean is negative: it draws blood out, and no pump brings any in; a flow into the "
            "vessel is positive"
        )
    return Drive(name, f"pump, {_amount(mean, least, most, 'm^3/s', wave)}", tuple(questions))


def _reservoir(name: str, table: OpeningTable, pressure: float, wave: Waveform) -> Drive:
    mean, least, most = pressure * wave.mean, *sorted((pressure * wave.least, pressure * wave.most))
    peak = max(abs(least), abs(most))
    questions = [*_doubts_of_period(wave, table.waveform), *_doubts_of_factor(wave, table.waveform)]
    if most > HIGHEST_PRESSURE:
        questions.append(
            f"{most:.4g} Pa is {most / MMHG:.0f} mmHg, above any artery's; is the pressure in Pa "
            "(1 mmHg is 133 Pa)?"
        )
    if least < LOWEST_PRESSURE:
        questions.append(
            f"{least:.4g} Pa is {least / MMHG:.0f} mmHg below that outside: stronger than suction "
            "pumps draw; is its sign right?"
        )
    if peak > 0.0 and abs(mean) < NO_MEAN * peak:
        questions.append("its mean is zero: on average it neither gives nor takes blood")
    amount = _amount(mean, least, most, "Pa", wave, f" ({mean / MMHG:.3g} mmHg)")
    return Drive(name, f"reservoir, {amount}", tuple(questions))


def _amount(
    mean: float, least: float, most: float, unit: str, wave: Waveform, other_unit: str = ""
) -> str:
    unit += other_unit
    if wave.is_steady:
        return f"{mean:.5g} {unit}, steady"
    bounds = f"from {least:.4g} to {most:.4g}" if least < 0.0 else f"at most {most:.4g}"
    return f"{mean:.4g} {unit} on average, {bounds}, period {wave.period:.4g} s"


def _doubts_of_period(wave: Waveform, file: str | None) -> Iterator[str]:
    if wave.is_steady:
        return
    if wave.period > LONGEST_PERIOD:
        yield (
            f"{file} repeats every {wave.period:.4g} s: no heart beats so slowly; are its times "
            "in s, or in ms?"
        )
    if wave.period < SHORTEST_PERIOD:
        yield (
            f"{file} repeats every {wave.period:.4g} s: no heart beats so fast; are its times in s?"
        )


def _doubts_of_factor(wave: Waveform, file: str | None) -> Iterator[str]:
    largest = max(abs(wave.least), abs(wave.most))
    if wave is STEADY or largest == 0.0:
        return
    if abs(wave.mean) > LARGEST_MEAN_FACTOR or largest < SMALLEST_FACTOR:
        yield (
            f"{file} multiplies by {wave.mean:.3g} on average, by {largest:.3g} at most: it is a "
            "factor, about 1; are its values a flow or a pressure?"
        )
