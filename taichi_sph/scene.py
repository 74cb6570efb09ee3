"""Scene: what the user wrote, checked.  TOML -> frozen structures, SI units.

Nothing here imports taichi; derived numbers are worked out elsewhere and printed, never typed.
"""

import math
import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import msgspec
from msgspec import inspect

from taichi_sph.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LARGEST = 1e12
"""Nothing in SI units is as large in a vessel; keeps infinity out."""

Positive = Annotated[float, msgspec.Meta(gt=0, lt=LARGEST)]
NonNegative = Annotated[float, msgspec.Meta(ge=0, lt=LARGEST)]
Coordinate = Annotated[float, msgspec.Meta(gt=-LARGEST, lt=LARGEST)]
SurfaceFile = Annotated[str, msgspec.Meta(extra={"file": "surface"})]
ToolFile = Annotated[str, msgspec.Meta(extra={"file": "tool"})]
WaveformFile = Annotated[str | None, msgspec.Meta(extra={"file": "waveform"})]
"""Keys that name a file are of such a type: `scene_files` then knows it by its content."""
Vector = tuple[Coordinate, Coordinate, Coordinate]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A TOML table in which an unknown key is an error."""


class VesselTable(_Table):
    """The lumen surface."""

    surface: SurfaceFile
    """Surface file (STL, PLY, OBJ, VTP, VTK), relative to the scene file."""
    scale: Positive = 1.0
    """Metres per unit of the surface file [m]."""


class OpeningTable(_Table):
    """One opening of the vessel; geometry is read off the surface, this says which one."""

    centre: Vector
    """A point near the middle of the opening [units of the surface file]."""
    state: Literal["open", "capped"] = "open"
    """Blood leaves through an open one and is counted; a capped one is wall."""
    flow: Coordinate | None = None
    """Blood that a pump drives in [m^3/s], out where negative."""
    pressure: Coordinate | None = None
    """Pressure that a reservoir holds there [Pa], over that outside the vessel."""
    waveform: WaveformFile = None
    """What flow or pressure is multiplied by: the name of a built-in one, or a CSV file (time [s],
    factor), relative to the scene file; it repeats.  Steady without."""

    @property
    def driven(self) -> bool:
        """Whether a pump or a reservoir drives blood through it."""
        return self.flow is not None or self.pressure is not None

    def __post_init__(self) -> None:
        if self.flow is not None and self.pressure is not None:
            raise ValueError("give flow [m^3/s] or pressure [Pa], not both")
        if self.driven and self.state == "capped":
            raise ValueError("a capped opening has no flow and no pressure; set state = 'open'")
        if self.waveform is not None and not self.driven:
            raise ValueError("a waveform needs a flow [m^3/s] or a pressure [Pa] to multiply")


class WallTable(_Table):
    """A wall that pulses; without this table it stands still."""

    pulse: Positive
    """How far it moves out along its normal [m]; the surface of the file is its narrowest."""
    waveform: WaveformFile
    """When: the name of a built-in waveform, or a CSV file (time [s], factor), relative to the
    scene file; its lowest factor is narrow, its highest wide."""


class ToolTable(_Table):
    """A rigid tool that a session moves."""

    surface: ToolFile
    """Closed surface file (STL, PLY, OBJ, VTP, VTK), relative to the scene file."""
    position: Vector
    """Where the origin of that file is at the start [m]: the tip, which suction is at."""
    scale: Positive = 1.0
    """Metres per unit of the surface file [m]."""


class Column(_Table):
    """The blood at the start: a column in the lumen, at rest.  Give height, particles or full."""

    opening: str
    """The opening that the column stands at."""
    height: Positive | None = None
    """Depth of the column, from its top inward along the opening's normal [m]."""
    particles: Annotated[int, msgspec.Meta(gt=0)] | None = None
    """Number of blood particles; the height follows from it."""
    full: bool = False
    """The whole lumen."""
    offset: NonNegative = 0.0
    """Distance from the opening's plane to the top of the column [m]."""

    def __post_init__(self) -> None:
        if (self.height is not None) + (self.particles is not None) + self.full != 1:
            raise ValueError("give height [m], particles or full = true, one of the three")
        if self.full and self.offset:
            raise ValueError("an offset [m] leaves no full lumen")


class NewtonianTable(_Table, tag_field="model", tag="newtonian"):
    """Constant viscosity."""

    viscosity: Positive = 3.5e-3
    """Dynamic viscosity mu [Pa s]; 3.5 mPa s is blood's nominal one (Fluids 2017, 2, 10)."""


class CassonTable(_Table, tag_field="model", tag="casson"):
    """Casson's law, Eq. 8, with Papanastasiou's regulariser."""

    viscosity: Positive = 3.5e-3
    """Casson viscosity eta [Pa s] (Fung, Biomechanics, haematocrit 45 %)."""
    yield_stress: NonNegative = 5e-3
    """Yield stress tau_y [Pa] (Merrill: 2-10 mPa)."""
    regularisation: Positive = 7.0
    """Time n of the regulariser [s]; the paper's value."""
    printed: bool = False
    """Use the regulariser as the paper prints it, exp(-n g): thin at rest, for study only."""


class Blood(_Table):
    """The liquid."""

    density: Positive = 1060.0
    """Rest density rho_0 [kg/m^3] (svMultiPhysics test cases; 1050-1060)."""
    rheology: Union[NewtonianTable, CassonTable] = CassonTable()
    """Viscosity law."""
    artificial_viscosity: NonNegative = 0.0
    """Monaghan's alpha [-]: blood is then more viscous than its law says, for study only."""


class Discretization(_Table):
    """How finely the scene is resolved."""

    spacing: Positive
    """Distance d between blood particles at rest [m]."""
    support_ratio: Annotated[float, msgspec.Meta(ge=1.5, le=4.0)] = 2.0
    """Support radius R over spacing [-]."""
    wall_spacing_ratio: Annotated[float, msgspec.Meta(ge=0.25, le=1.0)] = 1.0
    """Spacing of the wall's proxy particles over that of blood [-]."""
    sound_speed_ratio: Annotated[float, msgspec.Meta(ge=2.0, le=100.0)] = 10.0
    """Sound speed over the largest speed that the drop allows [-]; 10 keeps density to 1 %."""
    courant_number: Annotated[float, msgspec.Meta(gt=0, le=2.0)] = 0.4
    """Step of the physics over R/2/(c + v) [-]: the textbook's; with more damping longer ones
    live, see docs/evidence.md."""
    integrator: Literal["symplectic", "paper"] = "symplectic"
    """Semi-implicit Euler, or Eqs. 17 and 18 as printed (unstable: for study only)."""
    viscous_form: Literal["pairwise", "nested"] = "pairwise"
    """Morris' pairwise form, or the paper's nested form of Eqs. 10 and 12."""


class Scene(_Table):
    """A vessel, the blood in it, and how long to watch."""

    title: str
    vessel: VesselTable
    column: Column
    discretization: Discretization
    duration: Positive
    """Simulated time of a run [s]."""
    frame_interval: Positive
    """Simulated time between two frames [s]."""
    gravity: Vector
    """Body force per mass g [m/s^2]."""
    openings: dict[str, OpeningTable] = {}
    """Openings by name; one that the surface has and the scene does not name is capped."""
    blood: Blood = Blood()
    tool: ToolTable | None = None
    wall: WallTable | None = None
    folder: str = "."
    """Where relative paths start: the scene file's folder (set by the reader)."""
    name: str = "scene"
    """Short name (set by the reader)."""
    text: str = ""
    """The TOML text as read, kept in recordings (set by the reader)."""

    @property
    def driver(self) -> str:
        """What drives the blood beside gravity, as "openings.inlet is driven"; empty if nothing."""
        for name, opening in self.openings.items():
            if opening.driven:
                return f"openings.{name} is driven"
        return "the wall pulses" if self.wall is not None else ""

    def __post_init__(self) -> None:
        if math.hypot(*self.gravity) > 1e3:
            raise ValueError(f"gravity: {self.gravity} m/s^2 is not a plausible body force")
        if self.openings and self.column.opening not in self.openings:
            allowed = ", ".join(self.openings)
            raise ValueError(
                f"column.opening: {self.column.opening!r} is not an opening; allowed: {allowed}"
            )


_SET_BY_READER = ("folder", "name", "text")
_WORDS = {
    "float": "a number", "int": "a whole number", "str": "text", "bool": "true or false",
    "object": "a table", "array": "a list",
}  # fmt: skip
"""What TOML calls what msgspec names otherwise."""


def _tables_in(kind: inspect.Type) -> list[inspect.StructType]:
    """Tables that a value of a kind may be: one for each rheology, for instance."""
    if isinstance(kind, inspect.Metadata):
        return _tables_in(kind.type)
    if isinstance(kind, inspect.UnionType):
        return [table for member in kind.types for table in _tables_in(member)]
    return [kind] if isinstance(kind, inspect.StructType) else []


def _kind_at(path: list[str], kind: inspect.Type, found: Any) -> tuple[inspect.Type, Any]:
    """What may stand at a place below a table of a kind, and what does."""
    for key in path:
        tables = _tables_in(kind)
        if key == tables[0].tag_field:
            kind = inspect.LiteralType(values=tuple(str(each.tag) for each in tables))
        else:
            kind = next(f.type for f in _chosen(tables, found).fields if f.encode_name == key)
        found = found.get(key) if isinstance(found, dict) else None
    return kind, found


def _chosen(tables: list[inspect.StructType], found: Any) -> inspect.StructType:
    """The table that is meant among several: by its tag, where there is one."""
    tag = found.get(tables[0].tag_field) if isinstance(found, dict) else None
    return next((each for each in tables if each.tag == tag), tables[0])


def _plain(error: Exception, of: type[msgspec.Struct], table: Any, place: str = "") -> str:
    """One sentence from msgspec's message: where, what was found, what is allowed.

    Args:
        error: of a conversion.
        of: what the table was to become.
        table: as it was written.
        place: of that table in the scene.
    """
    what, _, path = str(error).replace("`", "").partition(" - at $")
    path = path.lstrip(".")
    kind, found = _kind_at(path.split(".") if path else [], inspect.type_info(of), table)
    where = ".".join(part for part in (place, path) if part)
    where += ": " if where else ""
    if what.startswith("Object contains unknown field"):
        structure = _chosen(_tables_in(kind), found)
        keys = [structure.tag_field] if structure.tag_field else []
        keys += [f.encode_name for f in structure.fields if f.encode_name not in _SET_BY_READER]
        unknown = what.removeprefix("Object contains unknown field ")
        return f"{where}unknown key {unknown}; allowed: {', '.join(keys)}"
    if what.startswith("Object missing required field"):
        return f"{where}the key {what.split()[-1]} is missing"
    if what.startswith("Invalid") and isinstance(kind, inspect.LiteralType):
        return f"{where}found {found!r}; allowed: {', '.join(map(str, kind.values))}"
    if what.startswith("Expected"):
        wanted = what.removeprefix("Expected ").partition(", got")[0].removesuffix(" | null")
        first, _, rest = wanted.partition(" ")
        return f"{where}found {found!r}; expected {_WORDS.get(first, first)} {rest}".rstrip()
    return where + what


def _check_entries(table: dict[str, Any], source: str) -> None:
    """Check the tables that the user names, one by one: msgspec does not say which is wrong.

    Raises:
        InputError: one has a mistake.
    """
    for field in inspect.type_info(Scene).fields:  # type: ignore[attr-defined]
        named = table.get(field.encode_name)
        if not isinstance(field.type, inspect.DictType) or not isinstance(named, dict):
            continue
        (kind,) = _tables_in(field.type.value_type)
        for label, entry in named.items():
            try:
                msgspec.convert(entry, kind.cls)
            except msgspec.ValidationError as error:
                place = f"{field.encode_name}.{label}"
                raise InputError(f"{source}: {_plain(error, kind.cls, entry, place)}") from None


def parse_scene(text: str, source: str, folder: Path, name: str) -> Scene:
    """Build a scene from TOML text.

    Raises:
        InputError: the text is no TOML, a key is unknown or missing, a value is out of range.
    """
    try:
        table: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not a TOML file: {error}") from None
    for key in _SET_BY_READER:
        if key in table:
            raise InputError(f"{source}: unknown key {key}")
    table |= {"folder": str(folder), "name": name, "text": text}
    _check_entries(table, source)
    try:
        return msgspec.convert(table, Scene)
    except msgspec.ValidationError as error:
        raise InputError(f"{source}: {_plain(error, Scene, table)}") from None


def scene_name(path: Path) -> str:
    """The name of a scene's file: its folder's, however that is given, for `scene.toml`."""
    whole = Path(os.path.abspath(path))  # not resolved: a link has a name of its own
    name = whole.parent.name if whole.stem == "scene" else whole.stem
    # A name that is no UTF-8 is shown and recorded like any other.
    return os.fsencode(name).decode("utf-8", "replace") or "scene"


def read_scene(path: Path) -> Scene:
    """Read a scene file.

    Raises:
        InputError: as `parse_scene`, or the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise InputError(f"{path}: cannot read the scene: {reason}") from None
    return parse_scene(text, str(path), path.parent.resolve(), scene_name(path))
