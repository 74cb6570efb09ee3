"""Commands: what may be done to a running session, by a page, a script, a channel or a replay.

One JSON object each: {"command": "wound", "centre": [0.0, 0.01, 0.0], "radius": 0.001}.  SI units.
"""

from typing import Annotated, Any, Literal, Union

import msgspec

from taichi_sph.errors import InputError

Number = Annotated[float, msgspec.Meta(gt=-1e6, lt=1e6)]
"""Finite; nothing in a session is larger."""
Positive = Annotated[float, msgspec.Meta(gt=0, lt=1e6)]
Vector = tuple[Number, Number, Number]


class Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="command"):
    """What may be done to a running session."""


class Pause(Command, tag="pause"):
    """Hold the blood, or let it go on."""

    on: bool = True


class Step(Command, tag="step"):
    """One step, then pause."""


class Speed(Command, tag="speed"):
    """Go no faster than this."""

    factor: Positive | None = None
    """Simulated over wall time; as fast as can be without."""


class Gravity(Command, tag="gravity"):
    """Tilt."""

    vector: Vector
    """[m/s^2]"""


class Inflow(Command, tag="inflow"):
    """Turn a pump or a reservoir up or down."""

    factor: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    """What its flow or pressure is multiplied by, beside its waveform."""
    opening: str | None = None
    """The opening; all driven ones without."""


class Model(Command, tag="model"):
    """Change what computes the accelerations."""

    name: Literal["physics", "implicit", "pcnet", "auto"]
    """auto: pcnet while it stays within its training, the physics where it does not."""


class Tool(Command, tag="tool"):
    """Where the tool is wanted; it goes there as fast as a hand."""

    position: Vector
    """Of its origin [m]."""
    rotation: tuple[Number, Number, Number, Number] | None = None
    """Quaternion w, x, y, z; as it is without."""


class Suction(Command, tag="suction"):
    """Suck blood away at the tool's position."""

    rate: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    """At most this much [m^3/s]; 0 ends it."""
    radius: Positive | None = None
    """Blood no farther than this from the tip is taken [m]; two spacings without."""


class Wound(Command, tag="wound"):
    """Open the wall."""

    centre: Vector
    """A point at the wall [m]."""
    radius: Positive
    """Of a puncture, or half the width of a cut [m]."""
    end: Vector | None = None
    """The other end of a cut [m]."""


class Clamp(Command, tag="clamp"):
    """Close a wound."""

    wound: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Its number, from 0; all without."""


class Reset(Command, tag="reset"):
    """Blood, wounds and tool as at the start; the clock goes on."""


AnyCommand = Union[Pause, Step, Speed, Gravity, Inflow, Model, Tool, Suction, Wound, Clamp, Reset]
NAMES = tuple(
    str(c.__struct_config__.tag)
    for c in (Pause, Step, Speed, Gravity, Inflow, Model, Tool, Suction, Wound, Clamp, Reset)
)


def parse_command(given: bytes | str | dict[str, Any]) -> AnyCommand:
    """A command from JSON, or from what JSON has become.

    Raises:
        InputError: it is none; what was found and what is allowed.
    """
    try:
        if isinstance(given, dict):
            return msgspec.convert(given, AnyCommand)
        return msgspec.json.decode(given, type=AnyCommand)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as e:
        what = str(e).replace("`", "")
        raise InputError(f"no command: {what}; allowed are {', '.join(NAMES)}") from None


def as_dict(command: AnyCommand) -> dict[str, Any]:
    """What JSON makes of a command, without what is not given."""
    table = msgspec.to_builtins(command)
    return {key: value for key, value in table.items() if value is not None}
