"""Controls of the page: a table that says which command each gives, and how it is made."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from app.control.commands import (
    LARGEST_FACTOR,
    Clamp,
    Command,
    Dye,
    Gravity,
    Inflow,
    Model,
    Pause,
    Reset,
    Speed,
    Step,
    Suction,
    Tool,
    Wound,
)
from taichi_sph.boundary.wounds import LEAST_RADIUS
from taichi_sph.geometry.mesh import Floats

if TYPE_CHECKING:
    from app.control.page_scene import PageScene
    from app.control.session import Session

MM, ML, ML_MIN = 1e3, 1e6, 6e7
"""Factors from SI to the units of the page: mm, ml, ml/min."""
_FASTEST = 2.0
"""End of the slider for the speed limit [x real time]: little blood runs faster here."""
_SUCTION_RATE = 200.0
"""Rate to begin with [ml/min]: a third of what the shipped session sucks from the aorta."""

Wish = Callable[[Any, Callable[[], Command]], None]
"""Has a control of viser ask for a command: the control, and what makes the command."""


@dataclass(frozen=True)
class Panel:
    """What controls are made of and act on."""

    gui: Any
    session: "Session"
    scene: "PageScene"
    wish: Wish


def tilted(gravity: Floats, right: Floats, back: Floats, turns: tuple[float, float]) -> Floats:
    """Gravity [m/s^2] that pulls to the right by the first angle [deg], to the eye by the second.

    Args:
        gravity: upright [m/s^2].
        right: unit vector, to the right of who looks.
        back: unit vector, level, towards who looks.
        turns: the angles [deg].
    """
    sideways, towards = np.radians(turns)
    turn = Rotation.from_rotvec(sideways * back) * Rotation.from_rotvec(-towards * right)
    return np.asarray(turn.apply(gravity))


def vector(values: Any) -> tuple[float, float, float]:
    """Three numbers of numpy as Python's."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def add_run(panel: Panel) -> None:
    """Buttons: hold, go on, one step, reset."""
    commands: dict[str, Command] = {
        "hold": Pause(on=True),
        "go on": Pause(on=False),
        "one step": Step(),
        "reset": Reset(),
    }
    buttons = panel.gui.add_button_group("blood", tuple(commands))
    panel.wish(buttons, lambda: commands[buttons.value])


def add_speed(panel: Panel) -> None:
    """Slider of the speed limit."""
    speed = panel.gui.add_slider(
        "speed limit", 0.0, _FASTEST, 0.05, 0.0, hint="x real time; 0: no limit"
    )
    panel.wish(speed, lambda: Speed(factor=speed.value or None))


def add_model(panel: Panel) -> None:
    """Choice of the model, of those that are ready."""
    models = panel.session.models
    model = panel.gui.add_dropdown("model", models.names, initial_value=models.selected)
    panel.wish(model, lambda: Model(name=model.value))


def add_gravity(panel: Panel) -> None:
    """Sliders that tilt the vessel."""
    upright = np.array(panel.session.simulation.scene.gravity)
    scene = panel.scene
    right, towards = (
        panel.gui.add_slider(name, -180.0, 180.0, 1.0, 0.0)
        for name in ("right [deg]", "to you [deg]")
    )

    def gravity() -> Command:
        turns = (right.value, towards.value)
        return Gravity(vector=vector(tilted(upright, scene.right, scene.back, turns)))

    for slider in (right, towards):
        panel.wish(slider, gravity)


def add_inflow(panel: Panel) -> None:
    """A slider for each driven opening."""
    for name in panel.session.driven:
        _add_factor(panel, name)


def _add_factor(panel: Panel, name: str) -> None:
    factor = panel.gui.add_slider(name, 0.0, LARGEST_FACTOR, 0.05, 1.0)
    panel.wish(factor, lambda: Inflow(factor=factor.value, opening=name))


def add_tool(panel: Panel) -> None:
    """The handle in the scene."""
    handle = panel.scene.tool_handle
    turns = panel.session.simulation.tool.surface is not None
    panel.gui.add_markdown("Drag the larger gizmo: the tool follows.")

    def aim() -> Command:
        w, *xyz = map(float, handle.wxyz)
        rotation = (w, *vector(xyz)) if turns else None
        return Tool(position=vector(handle.position), rotation=rotation)

    panel.wish(handle, aim)


def add_suction(panel: Panel) -> None:
    """Rate and switch of the suction."""
    rate = panel.gui.add_number("rate [ml/min]", _SUCTION_RATE, min=0.0, step=10.0)
    is_on = panel.gui.add_checkbox("suction", False)
    for control in (rate, is_on):
        panel.wish(control, lambda: Suction(rate=is_on.value * rate.value / ML_MIN))


def add_wound(panel: Panel) -> None:
    """Radius and button of a puncture at the marker."""
    spacing = panel.session.simulation.scene.discretization.spacing
    marker = panel.scene.wound_marker
    panel.gui.add_markdown("Click the vessel, or drag the smaller gizmo.")
    least = round(MM * LEAST_RADIUS * spacing + 0.005, 2)
    radius = panel.gui.add_number("radius [mm]", round(1.5 * least, 1), min=least, step=0.1)
    button = panel.gui.add_button("Wound here", color="red")
    panel.wish(button, lambda: Wound(centre=vector(marker.position), radius=radius.value / MM))


def add_clamp(panel: Panel) -> None:
    """Choice of a wound and the button that closes it."""
    every = "all"
    which = panel.gui.add_dropdown("which", (every,))

    def show(numbers: list[int]) -> None:
        which.options = (every, *map(str, numbers))

    panel.scene.on_wounds = show
    button = panel.gui.add_button("Clamp")
    panel.wish(button, lambda: Clamp(wound=None if which.value == every else int(which.value)))


def add_dye(panel: Panel) -> None:
    """Buttons that mark blood inside the wall at the marker, and blood that comes in."""
    simulation, marker = panel.session.simulation, panel.scene.wound_marker
    spacing = simulation.scene.discretization.spacing
    radius = panel.gui.add_number(
        "dye radius [mm]", round(6.0 * MM * spacing, 1), min=round(MM * spacing, 2), step=0.1
    )
    ball = panel.gui.add_button("Dye here", color="cyan")
    panel.wish(ball, lambda: Dye(centre=vector(marker.position), radius=radius.value / MM))
    if panel.session.driven:
        opening = panel.gui.add_dropdown("dye what enters by", tuple(panel.session.driven))
        for label, concentration in (("Dye inflow", 1.0), ("Clear inflow", 0.0)):
            _add_inflow_dye(panel, label, opening, concentration)


def _add_inflow_dye(panel: Panel, label: str, opening: Any, concentration: float) -> None:
    button = panel.gui.add_button(label)
    panel.wish(button, lambda: Dye(opening=opening.value, concentration=concentration))


def always(session: "Session") -> bool:
    """Whether a control is shown that every session has."""
    return True


@dataclass(frozen=True)
class Control:
    """A row of the table."""

    folder: str
    commands: tuple[type[Command], ...]
    """What it asks for."""
    add: Callable[[Panel], None]
    shown: Callable[["Session"], bool] = always


CONTROLS = (
    Control("Run", (Pause, Step, Reset), add_run),
    Control("Run", (Speed,), add_speed),
    Control("Run", (Model,), add_model),
    Control("Gravity", (Gravity,), add_gravity, lambda s: any(s.simulation.scene.gravity)),
    Control("Inflow [x the scene's]", (Inflow,), add_inflow, lambda s: bool(s.driven)),
    Control("Tool and suction", (Tool,), add_tool),
    Control("Tool and suction", (Suction,), add_suction),
    Control("Wound", (Wound,), add_wound),
    Control("Wound", (Clamp,), add_clamp),
    Control("Dye", (Dye,), add_dye),
)
"""Controls in the order of the page, those of a folder together."""
NO_CONTROL: dict[type[Command], str] = {}
"""Commands that the page cannot give, and why."""


def add_controls(panel: Panel) -> None:
    """Add what a session has to the page, folder by folder."""
    folders: dict[str, Any] = {}
    for control in CONTROLS:
        if control.shown(panel.session):
            if control.folder not in folders:
                folders[control.folder] = panel.gui.add_folder(control.folder)
            with folders[control.folder]:
                control.add(panel)
