"""RerunView: a run as a Rerun recording, as a live view, or both.

File and live view are two streams.  Rerun blocks a stream whose viewer has stalled, so the live
one has a thread and a short queue that drops frames, and nothing waits for it.  The file has all.
"""

import hashlib
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.blueprint.visualizers import Visualizer

from app.view.appearance import (
    BACKGROUND,
    DROP_COLOUR,
    TOOL_COLOUR,
    WALL_COLOUR,
    WOUND_COLOUR,
    colouring,
    eye,
    upward,
)
from app.view.rerun_streams import (
    DISK_TIMEOUT,
    FILE_TICK,
    FileWriter,
    Items,
    LiveView,
    open_stream,
    send,
)
from taichi_sph.boundary.tracer import Tracer
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import vertex_normals

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation

_SHOWN_SECONDS = 10.0
"""How long a recording plays when it is opened [s]."""
_LABEL_DISTANCE = 0.4
"""From an opening to its name, over its radius."""
_NO_LABELS = 12
"""From this many openings on, their names would hide the vessel."""

Line = tuple[str, str, tuple[int, int, int]]
"""A line of a plot: its figure, its name and its colour."""

PLOTS: tuple[tuple[str, tuple[Line, ...]], ...] = (
    ("largest speed [m/s]", (("max_speed", "largest speed", (255, 170, 77)),)),
    ("kinetic energy [mJ]", (("kinetic_energy", "kinetic energy", (238, 85, 27)),)),
    (
        "compression [%]",
        (
            ("compression_p99", "99th percentile", (120, 200, 255)),
            ("compression_max", "largest", (70, 110, 160)),
        ),
    ),
    (
        "blood [ml]",
        (
            ("in_vessel", "in the vessel", (214, 43, 22)),
            ("drained", "drained", (150, 150, 170)),
            ("driven_in", "driven in", (110, 170, 255)),
            ("bled", "bled", (255, 170, 77)),
            ("sucked", "sucked away", (140, 220, 140)),
        ),
    ),
    (
        "wall",
        (
            ("leaks", "leaks", (255, 90, 200)),
            ("wall_corrections", "corrections since the start", (160, 130, 255)),
        ),
    ),
    ("time step [ms]", (("step", "time step", (140, 220, 140)),)),
    (
        "taken over by the physics [%]",
        (("fallback_share", "of the time so far", (230, 190, 120)),),
    ),
)
"""Plots by title.  Their figures are one row of one entity: of each entity that it writes Rerun
remembers a kilobyte for the end of the file."""
_FIGURES = pa.struct([(figure, pa.float64()) for _, lines in PLOTS for figure, *_ in lines])


def _line(figure: str, name: str, colour: tuple[int, int, int]) -> Visualizer:
    """A line of a plot."""
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component="figures:values",
        selector=f".{figure}",
    )
    return rr.SeriesLines(names=name, colors=[colour], widths=1.5).visualizer(mappings=[source])


def application_of(simulation: "Simulation") -> str:
    """Name by which viewers keep camera and layout: one for each vessel and its way up."""
    scene, text = simulation.scene, hashlib.sha256()
    text.update(np.ascontiguousarray(simulation.vessel.vertices, np.float64).tobytes())
    text.update(repr((scene.title, scene.gravity)).encode())
    return f"vesselflow {scene.name} {text.hexdigest()[:6]}"


class RerunView:
    """Observer that shows the blood in its vessel, and the diagnostics as plots."""

    def __init__(
        self,
        simulation: "Simulation",
        path: Path | None = None,
        port: int | None = None,
        every: int = 1,
        properties: dict[str, Any] | None = None,
        checkpoint: int | None = None,
        colour: str = "speed",
    ):
        """Open the file, the live view or both, and show what never changes.

        Args:
            simulation: at its start.
            path: file to record to.
            port: loopback port to serve a live view at.
            every: particles are shown each so many frames; plots have every frame.
            properties: kept with the recording: what program and machine it came from.
            checkpoint: the file has all up to each so many frames when `on_frame` is back.
            colour: what blood is coloured by, one of `appearance.COLOURINGS`.

        Raises:
            InputError: the file cannot be opened, the port is taken, or Rerun is switched off.
        """
        scene = simulation.scene
        self.every, self._checkpoint = every, checkpoint
        self._radius = 0.5 * scene.discretization.spacing
        self._volume = simulation.derived.blood_particles * scene.discretization.spacing**3
        self._colouring = colouring(colour, simulation)
        self._last: tuple[int, float] = (-1, 0.0)
        self._notes: Items = []
        self._wounded = self._sucked = False
        self._wall: tuple[np.ndarray, np.ndarray] | None = None
        """Vertices of a wall that pulses, and how far each moves [m]."""
        blueprint = self._blueprint(simulation)
        application, identity = application_of(simulation), str(uuid.uuid4())
        self._writer: FileWriter | None = None
        self._file: rr.RecordingStream | None = None
        self.live: LiveView | None = None
        if port is not None:
            self.live = LiveView(port, application, identity, blueprint)
        if path is not None:
            self._file = open_stream(application, identity, FILE_TICK)
            if not rr.is_enabled(self._file):
                raise InputError("--rrd: the environment variable RERUN switches recordings off")
            self._writer = FileWriter(path)
            self._file.set_sinks(rr.FileSink(self._writer.sink_path), default_blueprint=blueprint)
            self._writer.opened()
        for stream in self.streams:
            self._log_static(stream, simulation, properties or {})

    @property
    def streams(self) -> list[rr.RecordingStream]:
        """Where frames go: live view and file, as far as there are any."""
        live = [self.live.stream] if self.live else []
        return live + ([self._file] if self._file else [])

    def _blueprint(self, simulation: "Simulation") -> rrb.Blueprint:
        scene = simulation.scene
        up = upward(scene.gravity)
        position, target = eye(np.asarray(simulation.vessel.vertices, float), up)
        world = rrb.Spatial3DView(
            origin="/world",
            name=scene.title,
            background=rrb.Background(kind="SolidColor", color=list(BACKGROUND)),
            line_grid=False,
            eye_controls=rrb.EyeControls3D(
                kind="Orbital",
                position=position.tolist(),
                look_target=target.tolist(),
                eye_up=up.tolist(),
            ),
        )
        plots = [
            rrb.TimeSeriesView(
                origin="/figures",
                name=title,
                overrides={"/figures": [_line(*line) for line in lines]},
                # A single line is named by its title.
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=len(lines) > 1),
            )
            for title, lines in PLOTS
        ]
        return rrb.Blueprint(
            rrb.Horizontal(
                world,
                rrb.Vertical(
                    *plots[:4],
                    rrb.Tabs(
                        rrb.TextDocumentView(origin="/scene", name="scene"),
                        *plots[4:],
                        rrb.TextLogView(origin="/log", name="log"),
                    ),
                    row_shares=[1, 1, 1, 1, 1.6],
                ),
                column_shares=[2, 1],
            ),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(
                state="collapsed",
                timeline="sim_time",
                play_state="playing",
                loop_mode="all",
                playback_speed=scene.duration / _SHOWN_SECONDS,
            ),
            auto_views=False,
            auto_layout=False,
        )

    def _log_static(
        self, stream: rr.RecordingStream, simulation: "Simulation", properties: dict[str, Any]
    ) -> None:
        """Log what never changes."""
        scene, derived = simulation.scene, simulation.derived
        stream.send_recording_name(scene.title)
        metadata: dict[str, Any] = {
            "scene": scene.name,
            "blood_particles": derived.blood_particles,
            "proxy_particles": derived.proxy_particles,
            "spacing": scene.discretization.spacing,
            "support_radius": derived.support_radius,
            "sound_speed": derived.sound_speed,
            "colour": self._colouring.of,
            "colour_full_scale": self._colouring.full_scale,
        }
        stream.send_property("simulation", rr.AnyValues(**(metadata | properties)))
        axes = np.eye(3)
        up = int(np.abs(upward(scene.gravity)).argmax())
        sign = "UP" if upward(scene.gravity) @ axes[up] > 0.0 else "DOWN"
        coordinates = getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[up]}_{sign}")
        stream.log("world", coordinates, static=True)
        self._log_vessel(stream, simulation)
        self._log_styles(stream, simulation)
        stream.log("scene", rr.TextDocument(self._document(simulation), media_type="text/markdown"))

    def _log_vessel(self, stream: rr.RecordingStream, simulation: "Simulation") -> None:
        """Log the wall, open where blood may pass, and the names of the openings."""
        vessel = simulation.vessel
        is_open = np.array([opening.is_open for opening in vessel.openings] + [False])
        faces = vessel.faces[~is_open[vessel.face_opening]]
        used, faces = np.unique(faces, return_inverse=True)
        faces = faces.reshape(-1, 3)
        vertices = np.asarray(vessel.vertices, float)[used]
        normals = vertex_normals(vertices, faces)
        wall_motion = simulation.wall_motion
        if wall_motion is not None:
            amplitude = wall_motion.motion.amplitude_at(vessel, vertices)
            self._wall = vertices, amplitude[:, None] * normals
        mesh = rr.Mesh3D.from_fields(
            # What is static hides what is logged with a time.
            vertex_positions=vertices if wall_motion is None else None,
            triangle_indices=faces,
            vertex_normals=normals,
            albedo_factor=list(WALL_COLOUR),
        )
        stream.log("world/vessel", mesh, static=True)
        openings = vessel.openings
        if openings:
            names = rr.Points3D(
                [o.centre + _LABEL_DISTANCE * o.radius * o.normal for o in openings],
                labels=[f"{o.name} ({'open' if o.is_open else 'capped'})" for o in openings],
                radii=0.5 * self._radius,
                colors=[[150, 150, 170]],
                show_labels=len(openings) < _NO_LABELS,
            )
            stream.log("world/openings", names, static=True)

    def _log_styles(self, stream: rr.RecordingStream, simulation: "Simulation") -> None:
        """Log how thick and in what colours blood, droplets, wounds and tool are drawn."""
        styles: Items = [
            ("blood", rr.Points3D.from_fields(radii=self._radius)),
            ("drops", rr.Points3D.from_fields(radii=self._radius, colors=[DROP_COLOUR])),
            (
                "wounds",
                rr.LineStrips3D.from_fields(radii=0.3 * self._radius, colors=[WOUND_COLOUR]),
            ),
        ]
        shape = simulation.tool.surface
        if shape is None:
            styles.append(("tool", rr.Points3D.from_fields(colors=[TOOL_COLOUR])))
        else:
            body = rr.Mesh3D(
                vertex_positions=shape.vertices,
                triangle_indices=shape.faces,
                albedo_factor=TOOL_COLOUR,
            )
            styles.append(("tool/shape", body))
        for entity, style in styles:
            stream.log(f"world/{entity}", style, static=True)

    def _document(self, simulation: "Simulation") -> str:
        scene, derived, colour = simulation.scene, simulation.derived, self._colouring
        return (
            f"# {scene.title}\n\n"
            f"{derived.blood_particles} blood particles, {derived.proxy_particles} proxy "
            f"particles on the wall. Colour is {colour.of}: dark where blood is {colour.at_zero}, "
            f"pale at {colour.full_scale:.2g} {colour.unit} and above.\n\n"
            f"```toml\n{scene.text}\n```\n"
        )

    def on_frame(self, simulation: "Simulation", frame: int, diagnostics: "Diagnostics") -> None:
        """Show a frame.

        Raises:
            OSError: the recording cannot be written any more.
        """
        items, self._notes = self._notes, []
        if frame % self.every == 0:
            position, velocity = simulation.positions_and_velocities()
            tracer, in_order = simulation.boundary(Tracer), simulation.particles.in_order
            colours = self._colouring.colours(velocity, in_order(tracer.age), in_order(tracer.dye))
            items.append(("world/blood", rr.Points3D(position, colors=colours)))
            items += self._surgery(simulation)
            if self._wall is not None:
                narrow, way = self._wall
                wall = narrow + simulation.wall.displacement_factor * way
                items.append(("world/vessel", rr.Mesh3D.from_fields(vertex_positions=wall)))
        fraction = diagnostics.particles / max(1, simulation.derived.blood_particles)
        values = {
            "max_speed": diagnostics.max_speed,
            "kinetic_energy": 1e3 * diagnostics.kinetic_energy,
            "compression_p99": 1e2 * diagnostics.compression_p99,
            "compression_max": 1e2 * diagnostics.compression_max,
            "in_vessel": 1e6 * fraction * self._volume,
            "drained": 1e6 * diagnostics.drained_volume,
            "driven_in": 1e6 * diagnostics.added_volume,
            "bled": 1e6 * diagnostics.bled_volume,
            "sucked": 1e6 * diagnostics.sucked_volume,
            "leaks": diagnostics.leaks,
            "wall_corrections": diagnostics.wall_corrections,
            "step": 1e3 * diagnostics.step,
            "fallback_share": 1e2 * diagnostics.fallback_share,
        }
        row = pa.array([values], type=_FIGURES)
        items.append(("figures", rr.DynamicArchetype("figures", components={"values": row})))
        self._last = (frame, diagnostics.time)
        if self._file and self._writer:
            self._writer.check()
            send(self._file, frame, diagnostics.time, items)
            if self._checkpoint and frame % self._checkpoint == 0:
                # A full disk is said at the next frame, for the checkpoint can still be written.
                try:
                    self._file.flush(timeout_sec=DISK_TIMEOUT)
                except RuntimeError:
                    if not self._writer.error:
                        raise self._writer.timeout_error from None
                self._writer.drain()
        if self.live:
            self.live.offer(frame, diagnostics.time, items)

    def _surgery(self, simulation: "Simulation") -> Items:
        """Drops outside, open wounds and the tool."""
        items: Items = []
        # After a reset there are none any more, which must be said too.
        self._wounded |= len(simulation.wounds) > 0
        if self._wounded:
            items.append(("world/drops", rr.Points3D(simulation.outlets.droplets())))
            rims = rr.LineStrips3D([w.rim() for w in simulation.wounds if w.is_open])
            items.append(("world/wounds", rims))
        tool, suction = simulation.tool, simulation.suction
        if tool.surface is not None:
            pose = rr.Transform3D(
                translation=tool.position, quaternion=rr.Quaternion(xyzw=tool.rotation.as_quat())
            )
            items.append(("world/tool", pose))
        else:
            sucks = suction.rate > 0.0
            self._sucked |= sucks
            if self._sucked:
                places = [tool.position] if sucks else []
                tip = rr.Points3D(places, radii=suction.radius)
                items.append(("world/tool", tip))
        return items

    def note(self, text: str) -> None:
        """Keep a sentence in the log, at the time of the frame that is under way."""
        self._notes.append(("log", rr.TextLog(text, level=rr.TextLogLevel.INFO)))

    def close(self, ending: str) -> bool:
        """Say how the run ended and finish the file.

        Returns:
            whether a viewer has stalled: Rerun would wait half a minute for it at Python's exit.

        Raises:
            OSError: the recording could not be written to its end.
        """
        frame, time = self._last
        last: Items = [("log", rr.TextLog(ending, level=rr.TextLogLevel.INFO))]
        stalled = False
        if self.live:
            self.live.offer(max(frame, 0), time, last)
            stalled = not self.live.close()
        if self._file and self._writer:
            send(self._file, max(frame, 0), time, last)
            self._file.disconnect()
            self._writer.close()
        return stalled
