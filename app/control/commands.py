"""Commands: what may be done to a running session, by a page, a script, a channel or a replay.

One JSON object each: {"command": "wound", "centre": [0.0, 0.01, 0.0], "radius": 0.001}.  SI units.
A command is one class: its keys, what can be refused at once (`check`) and what it does (`apply`).
"""

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol, Union

import msgspec
import numpy as np

from taichi_sph.boundary.tracer import Tracer
from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.control.auto_model import ModelSelection
    from taichi_sph.simulation import Simulation

Number = Annotated[float, msgspec.Meta(gt=-1e6, lt=1e6)]
"""Finite; nothing in a session is larger."""
Positive = Annotated[float, msgspec.Meta(gt=0, lt=1e6)]
Vector = tuple[Number, Number, Number]

STRONGEST_GRAVITY = 30.0
"""Bound of a gravity that is commanded [m/s^2]: three times the Earth's."""
LARGEST_FACTOR = 2.0
"""Bound of an inflow's factor: the sound speed is chosen for the scene's own flow."""


class CommandedSession(Protocol):
    """What commands act on: a session, as far as they need it."""

    simulation: "Simulation"
    models: "ModelSelection"
    driven: list[str]
    """Names of the openings that something drives."""

    def hold(self, on: bool) -> None:
        """Hold the blood, or let it go on."""

    def step_once(self) -> None:
        """Let one step pass, then hold the blood."""

    def limit_speed(self, factor: float | None) -> None:
        """Go no faster than a factor times real time; as fast as can be with None."""

    def reset_rates(self) -> None:
        """Begin the means over the last frames anew."""


class Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="command"):
    """What may be done to a running session."""

    affects_pacing_only: ClassVar[bool] = False
    """Whether it changes when blood moves, but not how; a replay leaves it out."""

    def check(self, session: CommandedSession) -> None:
        """Refuse what can be seen at once, from any thread, to be impossible.

        Raises:
            InputError: what was asked for and what is allowed.
        """

    def apply(self, session: CommandedSession) -> "Command":
        """Do it between two steps; returns what was done, which is within its bounds.

        Raises:
            InputError: it cannot be done; nothing has changed.
        """
        raise NotImplementedError


class Pause(Command, frozen=True, tag="pause"):
    """Hold the blood, or let it go on."""

    affects_pacing_only = True
    on: bool = True

    def apply(self, session: CommandedSession) -> Command:
        """Hold or go on."""
        session.hold(self.on)
        return self


class Step(Command, frozen=True, tag="step"):
    """Let one step pass, then hold the blood."""

    affects_pacing_only = True

    def apply(self, session: CommandedSession) -> Command:
        """Ask for the step."""
        session.step_once()
        return self


class Speed(Command, frozen=True, tag="speed"):
    """Limit the speed of the run."""

    affects_pacing_only = True
    factor: Positive | None = None
    """Simulated over wall time; as fast as can be without."""

    def apply(self, session: CommandedSession) -> Command:
        """Set the limit."""
        session.limit_speed(self.factor)
        return self


class Gravity(Command, frozen=True, tag="gravity"):
    """Give gravity another direction or strength."""

    vector: Vector
    """Gravity [m/s^2]."""

    def apply(self, session: CommandedSession) -> Command:
        """Set gravity, of STRONGEST_GRAVITY at most."""
        strength = float(np.linalg.norm(self.vector))
        bound = min(1.0, STRONGEST_GRAVITY / max(strength, 1e-30))
        x, y, z = (bound * value for value in self.vector)
        session.simulation.gravity = (x, y, z)
        return Gravity(vector=(x, y, z))


class Inflow(Command, frozen=True, tag="inflow"):
    """Turn a pump or a reservoir up or down."""

    factor: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    """Multiplies its flow or pressure, beside its waveform."""
    opening: str | None = None
    """Name of the opening; all driven ones without."""

    def check(self, session: CommandedSession) -> None:
        """Refuse an opening that nothing drives."""
        if not session.driven:
            raise InputError("inflow: nothing drives this scene's blood")
        if self.opening not in (None, *session.driven):
            allowed = ", ".join(session.driven)
            raise InputError(f"inflow: nothing drives {self.opening!r}; driven: {allowed}")

    def apply(self, session: CommandedSession) -> Command:
        """Set the factor, of LARGEST_FACTOR at most."""
        done = Inflow(factor=min(self.factor, LARGEST_FACTOR), opening=self.opening)
        session.simulation.inflow.set_factor(done.factor, done.opening)
        return done


class Model(Command, frozen=True, tag="model"):
    """Change what computes the accelerations."""

    name: Literal["physics", "implicit", "pcnet", "auto"]
    """Name of the model; auto is pcnet while blood stays within its training, implicit otherwise.
    """

    def check(self, session: CommandedSession) -> None:
        """Refuse a model that is not ready."""
        session.models.check(self.name)

    def apply(self, session: CommandedSession) -> Command:
        """Have it compute from the next step on."""
        session.models.select(self.name)
        return self


class Tool(Command, frozen=True, tag="tool"):
    """Say where the tool is wanted; it goes there as fast as a hand."""

    position: Vector
    """Place of its origin [m]."""
    rotation: tuple[Number, Number, Number, Number] | None = None
    """Quaternion w, x, y, z; as it is without."""

    def apply(self, session: CommandedSession) -> Command:
        """Set the target, inside the box that blood may be in."""
        low, high = (corner.tolist() for corner in session.simulation.bounds)
        x, y, z = map(max, low, map(min, self.position, high))
        session.simulation.tool.move_to(np.array((x, y, z)), unit_quaternion(self.rotation))
        return Tool(position=(x, y, z), rotation=self.rotation)


class Suction(Command, frozen=True, tag="suction"):
    """Suck blood away at the tool's position."""

    rate: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    """Largest flow that is taken [m^3/s]; 0 ends it."""
    radius: Positive | None = None
    """Blood no farther than this from the tip is taken [m]; two spacings without."""

    def apply(self, session: CommandedSession) -> Command:
        """Set rate and radius."""
        session.simulation.suction.set(self.rate, self.radius)
        return self


class Wound(Command, frozen=True, tag="wound"):
    """Open the wall."""

    centre: Vector
    """A point at the wall [m]."""
    radius: Positive
    """Radius of a puncture, or half the width of a cut [m]."""
    end: Vector | None = None
    """The other end of a cut [m]."""

    def apply(self, session: CommandedSession) -> Command:
        """Open the wall there."""
        end = None if self.end is None else np.array(self.end)
        session.simulation.wounds.open(np.array(self.centre), self.radius, end)
        return self


class Clamp(Command, frozen=True, tag="clamp"):
    """Close a wound."""

    wound: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Number of the wound, from 0; all without."""

    def apply(self, session: CommandedSession) -> Command:
        """Put the wall back."""
        session.simulation.wounds.close(self.wound)
        return self


class Dye(Command, frozen=True, tag="dye"):
    """Mark blood with a contrast medium: a ball of it, or what comes in through an opening."""

    centre: Vector | None = None
    """Middle of the ball [m]."""
    radius: Positive | None = None
    """Radius of the ball [m]."""
    opening: str | None = None
    """Driven opening, in place of a ball: all blood that comes in by it from now on is marked."""
    concentration: Annotated[float, msgspec.Meta(ge=0, le=1)] = 1.0
    """Concentration over that of the medium as injected; 0 takes the dye away."""

    def check(self, session: CommandedSession) -> None:
        """Refuse what is neither a ball nor a driven opening."""
        is_ball = self.centre is not None and self.radius is not None
        if is_ball == (self.opening is not None) or (self.centre is None) != (self.radius is None):
            raise InputError("dye: give centre and radius [m], or an opening, one of the two")
        if self.opening is not None and self.opening not in session.driven:
            allowed = ", ".join(session.driven) or "none"
            raise InputError(f"dye: no blood comes in through {self.opening!r}; driven: {allowed}")

    def apply(self, session: CommandedSession) -> Command:
        """Mark it."""
        tracer = session.simulation.boundary(Tracer)
        if self.opening is not None:
            tracer.mark_inflow(self.opening, self.concentration)
        elif self.centre is not None and self.radius is not None:
            tracer.mark_ball(np.array(self.centre), self.radius, self.concentration)
        return self


class Reset(Command, frozen=True, tag="reset"):
    """Put blood, wounds, dye, tool and gravity back to the start; the clock goes on."""

    def apply(self, session: CommandedSession) -> Command:
        """Put them back."""
        session.simulation.reset()
        session.reset_rates()
        return self


COMMANDS: tuple[type[Command], ...] = (
    Pause, Step, Speed, Gravity, Inflow, Model, Tool, Suction, Wound, Clamp, Dye, Reset,
)  # fmt: skip
"""All commands.  The names, the parser, the page's controls and the documentation follow it."""
NAMES = tuple(str(command.__struct_config__.tag) for command in COMMANDS)
_ANY: Any = Union[COMMANDS]


def parse_command(value: bytes | str | dict[str, Any]) -> Command:
    """A command from JSON, or from what JSON has become.

    Raises:
        InputError: it is none; what was found and what is allowed.
    """
    try:
        if isinstance(value, dict):
            command: Command = msgspec.convert(value, _ANY)
        else:
            command = msgspec.json.decode(value, type=_ANY)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as e:
        what = str(e).replace("`", "")
        raise InputError(f"no command: {what}; allowed are {', '.join(NAMES)}") from None
    return command


def as_dict(command: Command) -> dict[str, Any]:
    """What JSON makes of a command, without what is not given."""
    table = msgspec.to_builtins(command)
    return {key: value for key, value in table.items() if value is not None}


def unit_quaternion(rotation: tuple[float, ...] | None) -> np.ndarray | None:
    """A quaternion of length one; none of one without length."""
    if rotation is None or not np.linalg.norm(rotation) > 1e-6:
        return None
    return np.array(rotation) / np.linalg.norm(rotation)
