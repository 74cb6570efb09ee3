"""RerunView: a run as a Rerun recording, as a live view, or both; the only import of rerun.

File and live view are two streams.  Rerun blocks a stream whose viewer has stalled, so the live
one has a thread and a short queue that drops frames, and nothing waits for it.  The file has all.
"""

import errno
import os
import queue
import select
import socket
import threading
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What goes wrong is said by this program, in a sentence.
os.environ.setdefault("RUST_LOG", "off")

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.blueprint.visualizers import Visualizer

from app.view.appearance import (
    BACKGROUND,
    DROP_COLOUR,
    PACKED_COLOURS,
    TOOL_COLOUR,
    WALL_COLOUR,
    WOUND_COLOUR,
    eye,
    speed_levels,
    upward,
)
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import vertex_normals

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation

APPLICATION = "vesselflow"
LIVE_MEMORY = "64MiB"
"""What the server keeps of the past for viewers that come late; it takes twice that."""
_BATCH = 64 << 20
"""Bytes of a batch: with the default small rows starve beside large ones."""
_FILE_TICK = 2.0
"""A write follows the last by this or twice this [s]; Rerun remembers 10 kB of each for the end."""
_LIVE_TICK = 0.02
"""Between two messages to viewers [s]."""
_TIMEOUT = 60.0
"""Longest wait for the disk, at a checkpoint and at the end [s]."""
_LIVE_TIMEOUT = 2.0
"""Longest wait for a viewer at the end [s]."""
_LIVE_QUEUE = 4
"""Frames that wait for a viewer before frames are dropped."""
_SHOWN_SECONDS = 10.0
"""How long a recording plays when it is opened [s]."""
_LABEL_DISTANCE = 0.4
"""From an opening to its name, over its radius."""
_NO_LABELS = 12
"""From this many openings on, their names would hide the vessel."""

Line = tuple[str, str, tuple[int, int, int]]
"""Of a plot: its figure, its name and its colour."""

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

Items = list[tuple[str, Any]]

_stalled: "list[LiveView]" = []


def viewer_stalled() -> bool:
    """Whether a viewer has stalled: Rerun would wait half a minute for it at Python's exit."""
    return bool(_stalled)


class FileWriter:
    """Bytes of a recording on their way to a file.

    Rerun's own file writer dies silently on a full disk, and closing it then hangs.  Given a pipe
    it sees no error: this thread empties the pipe, writes the file and keeps what went wrong.
    """

    def __init__(self, path: Path):
        """Open the file.

        Raises:
            InputError: it cannot be opened.
        """
        self.path = path
        self.error: OSError | None = None
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise InputError(f"--rrd {path}: cannot be written: {error.strerror}") from None
        self._pumping = threading.Lock()
        self._source, self._sink = os.pipe()
        self.sink_path = f"/dev/fd/{self._sink}"
        self._thread = threading.Thread(target=self._pump, daemon=True, name="recording")
        self._thread.start()

    def opened(self) -> None:
        """Rerun has opened the pipe: it alone holds the writing end now."""
        os.close(self._sink)

    def _pump(self) -> None:
        data = b"all"
        while data:
            self._waits(None)
            with self._pumping:
                data = os.read(self._source, 1 << 20)
                rest = memoryview(data)
                try:
                    while rest and not self.error:
                        rest = rest[self._file.write(rest) :]
                except OSError as error:
                    self.error = error
        try:
            # Some file systems tell of a full disk only now; a device cannot be synchronised.
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                self.error = self.error or error
        finally:
            os.close(self._source)
            self._file.close()

    def _waits(self, patience: int | None) -> bool:
        """Whether bytes are in the pipe, or come before so long [ms], or it is closed."""
        asked = select.poll()
        asked.register(self._source, select.POLLIN)
        return bool(asked.poll(patience))

    def empty(self) -> None:
        """Wait until the pipe is empty and what was in it is in the file, or cannot be.

        Raises:
            OSError: the disk does not answer.
        """
        end = time.monotonic() + _TIMEOUT
        while self._thread.is_alive() and not self.error:
            if self._pumping.acquire(timeout=_TIMEOUT):
                waiting = self._waits(0)
                self._pumping.release()
                if not waiting:
                    return
            if time.monotonic() > end:
                raise self.silent
            time.sleep(1e-3)

    @property
    def silent(self) -> OSError:
        """What is said of a disk that does not answer."""
        return OSError(f"{self.path}: the disk has not answered for {_TIMEOUT:g} s")

    def check(self) -> None:
        """Raise what went wrong, if anything.

        Raises:
            OSError: the disk is full, or fails.
        """
        if self.error:
            raise OSError(
                f"{self.path}: the recording cannot be written: {self.error.strerror}; "
                "what is in it so far can be rescued with `rerun rrd optimize --continue-on-error`"
            )

    def close(self) -> None:
        """Wait for the last byte, after rerun has closed the pipe.

        Raises:
            OSError: as `check`, or the disk does not answer.
        """
        self._thread.join(_TIMEOUT)
        if self._thread.is_alive():
            raise self.silent
        self.check()


def _stream(identity: str, tick: float) -> rr.RecordingStream:
    stream = rr.RecordingStream(
        APPLICATION,
        recording_id=identity,
        batcher_config=rr.ChunkBatcherConfig(flush_num_bytes=_BATCH, flush_tick=tick),
    )
    stream.set_log_time_enabled(False)
    return stream


def _line(figure: str, name: str, colour: tuple[int, int, int]) -> Visualizer:
    """A line of a plot."""
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component="figures:values",
        selector=f".{figure}",
    )
    return rr.SeriesLines(names=name, colors=[colour], widths=1.5).visualizer(mappings=[source])


def _send(stream: rr.RecordingStream, frame: int, time: float, items: Items) -> None:
    stream.set_time("sim_time", duration=time)
    stream.set_time("frame", sequence=frame)
    for entity, archetype in items:
        stream.log(entity, archetype)


class LiveView:
    """A server on loopback that viewers connect to, come and go.

    For a viewer that has frozen Rerun holds about 0.5 GB, then this drops frames.
    """

    def __init__(self, port: int, identity: str, blueprint: rrb.Blueprint):
        """Serve at a port.

        Raises:
            InputError: the port is taken.
        """
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise InputError(f"--live {port}: no port to serve at: {error.strerror}") from None
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"
        self.dropped = 0
        self._delivered = False
        self.stream = _stream(identity, _LIVE_TICK)
        self.stream.set_sinks(
            rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit=LIVE_MEMORY),
            default_blueprint=blueprint,
        )
        self._queue: queue.Queue[tuple[int, float, Items] | None] = queue.Queue(_LIVE_QUEUE)
        self._thread = threading.Thread(target=self._pump, daemon=True, name="live view")
        self._thread.start()

    def _pump(self) -> None:
        while item := self._queue.get():
            _send(self.stream, *item)
        try:
            self.stream.flush(timeout_sec=_LIVE_TIMEOUT)
        except RuntimeError:
            return
        self._delivered = True
        self.stream.disconnect()

    def offer(self, frame: int, time: float, items: Items) -> None:
        """Show a frame, if the viewer keeps up."""
        try:
            self._queue.put_nowait((frame, time, items))
        except queue.Full:
            self.dropped += 1

    def close(self) -> bool:
        """End the server; False if a viewer has stalled and holds it up."""
        try:
            self._queue.put(None, timeout=_LIVE_TIMEOUT)
        except queue.Full:
            return False
        self._thread.join(2.0 * _LIVE_TIMEOUT)
        return self._delivered


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
    ):
        """Open the file, the live view or both, and show what never changes.

        Args:
            simulation: at its start.
            path: file to record to.
            port: loopback port to serve a live view at.
            every: particles are shown each so many frames; plots have every frame.
            properties: kept with the recording: what program and machine it came from.
            checkpoint: the file has all up to each so many frames when `on_frame` is back.

        Raises:
            InputError: the file cannot be opened, the port is taken, or Rerun is switched off.
        """
        scene = simulation.scene
        self.every, self._checkpoint = every, checkpoint
        self._radius = 0.5 * scene.discretization.spacing
        self._volume = simulation.derived.blood_particles * scene.discretization.spacing**3
        # Free fall over the whole height: little is faster.
        self.full_scale = simulation.derived.expected_speed or 1.0
        self._last: tuple[int, float] = (-1, 0.0)
        self._notes: Items = []
        self._wounded = self._sucked = False
        self._wall: tuple[np.ndarray, np.ndarray] | None = None
        """Vertices of a wall that pulses, and how far each moves [m]."""
        blueprint = self._blueprint(simulation)
        identity = str(uuid.uuid4())
        self._writer: FileWriter | None = None
        self._file: rr.RecordingStream | None = None
        self.live: LiveView | None = None
        if port is not None:
            self.live = LiveView(port, identity, blueprint)
        if path is not None:
            self._file = _stream(identity, _FILE_TICK)
            if not rr.is_enabled(self._file):
                raise InputError("--rrd: the environment variable RERUN switches recordings off")
            self._writer = FileWriter(path)
            self._file.set_sinks(rr.FileSink(self._writer.sink_path), default_blueprint=blueprint)
            self._writer.opened()
        for stream in self._streams():
            self._introduce(stream, simulation, properties or {})

    def _streams(self) -> list[rr.RecordingStream]:
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

    def _introduce(
        self, stream: rr.RecordingStream, simulation: "Simulation", properties: dict[str, Any]
    ) -> None:
        """Log what never changes."""
        scene, vessel, derived = simulation.scene, simulation.vessel, simulation.derived
        stream.send_recording_name(scene.title)
        facts: dict[str, Any] = {
            "scene": scene.name,
            "blood_particles": derived.blood_particles,
            "proxy_particles": derived.proxy_particles,
            "spacing": scene.discretization.spacing,
            "support_radius": derived.support_radius,
            "sound_speed": derived.sound_speed,
            "colour_full_scale": self.full_scale,
        }
        stream.send_property("simulation", rr.AnyValues(**(facts | properties)))
        axes = np.eye(3)
        up = int(np.abs(upward(scene.gravity)).argmax())
        sign = "UP" if upward(scene.gravity) @ axes[up] > 0.0 else "DOWN"
        coordinates = getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[up]}_{sign}")
        stream.log("world", coordinates, static=True)

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
        stream.log(
            "world/vessel",
            rr.Mesh3D.from_fields(
                # What is static hides what is logged with a time.
                vertex_positions=vertices if wall_motion is None else None,
                triangle_indices=faces,
                vertex_normals=normals,
                albedo_factor=list(WALL_COLOUR),
            ),
            static=True,
        )
        if vessel.openings:
            stream.log(
                "world/openings",
                rr.Points3D(
                    [
                        opening.centre + _LABEL_DISTANCE * opening.radius * opening.normal
                        for opening in vessel.openings
                    ],
                    labels=[
                        f"{o.name} ({'open' if o.is_open else 'capped'})" for o in vessel.openings
                    ],
                    radii=0.5 * self._radius,
                    colors=[[150, 150, 170]],
                    show_labels=len(vessel.openings) < _NO_LABELS,
                ),
                static=True,
            )
        looks: Items = [
            ("blood", rr.Points3D.from_fields(radii=self._radius)),
            ("drops", rr.Points3D.from_fields(radii=self._radius, colors=[DROP_COLOUR])),
            (
                "wounds",
                rr.LineStrips3D.from_fields(radii=0.3 * self._radius, colors=[WOUND_COLOUR]),
            ),
        ]
        shape = simulation.tool.surface
        if shape is None:
            looks.append(("tool", rr.Points3D.from_fields(colors=[TOOL_COLOUR])))
        else:
            body = rr.Mesh3D(
                vertex_positions=shape.vertices,
                triangle_indices=shape.faces,
                albedo_factor=TOOL_COLOUR,
            )
            looks.append(("tool/shape", body))
        for entity, look in looks:
            stream.log(f"world/{entity}", look, static=True)
        stream.log("scene", rr.TextDocument(self._document(simulation), media_type="text/markdown"))

    def _document(self, simulation: "Simulation") -> str:
        scene, derived = simulation.scene, simulation.derived
        return (
            f"# {scene.title}\n\n"
            f"{derived.blood_particles} blood particles, {derived.proxy_particles} proxy "
            f"particles on the wall. Colour is speed: dark red at rest, pale yellow at "
            f"{self.full_scale:.2g} m/s and above.\n\n```toml\n{scene.text}\n```\n"
        )

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Show a frame.

        Raises:
            OSError: the recording cannot be written any more.
        """
        items, self._notes = self._notes, []
        if frame % self.every == 0:
            position, velocity = simulation.positions_and_velocities()
            colours = PACKED_COLOURS[speed_levels(velocity, self.full_scale)]
            items.append(("world/blood", rr.Points3D(position, colors=colours)))
            items += self._surgery(simulation)
            if self._wall is not None:
                narrow, way = self._wall
                wall = narrow + simulation.wall.displacement_factor * way
                items.append(("world/vessel", rr.Mesh3D.from_fields(vertex_positions=wall)))
        in_vessel = figures.particles / max(1, simulation.derived.blood_particles) * self._volume
        values = {
            "max_speed": figures.max_speed,
            "kinetic_energy": 1e3 * figures.kinetic_energy,
            "compression_p99": 1e2 * figures.compression_p99,
            "compression_max": 1e2 * figures.compression_max,
            "in_vessel": 1e6 * in_vessel,
            "drained": 1e6 * figures.drained_volume,
            "driven_in": 1e6 * figures.added_volume,
            "bled": 1e6 * figures.bled_volume,
            "sucked": 1e6 * figures.sucked_volume,
            "leaks": figures.leaks,
            "wall_corrections": figures.wall_corrections,
            "step": 1e3 * figures.step,
            "fallback_share": 1e2 * figures.fallback_share,
        }
        row = pa.array([values], type=_FIGURES)
        items.append(("figures", rr.DynamicArchetype("figures", components={"values": row})))
        self._last = (frame, figures.time)
        if self._file and self._writer:
            self._writer.check()
            _send(self._file, frame, figures.time, items)
            if self._checkpoint and frame % self._checkpoint == 0:
                # A full disk is said at the next frame, for the checkpoint can still be written.
                try:
                    self._file.flush(timeout_sec=_TIMEOUT)
                except RuntimeError:
                    if not self._writer.error:
                        raise self._writer.silent from None
                self._writer.empty()
        if self.live:
            self.live.offer(frame, figures.time, items)

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

    def close(self, ending: str) -> None:
        """Say how the run ended and finish the file.

        Raises:
            OSError: the recording could not be written to its end.
        """
        frame, time = self._last
        last: Items = [("log", rr.TextLog(ending, level=rr.TextLogLevel.INFO))]
        if self.live:
            self.live.offer(max(frame, 0), time, last)
            if not self.live.close():
                _stalled.append(self.live)
        if self._file and self._writer:
            _send(self._file, max(frame, 0), time, last)
            self._file.disconnect()
            self._writer.close()
