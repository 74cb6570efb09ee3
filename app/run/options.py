"""What a run is asked for: the options of `vesselflow run`, checked against each other."""

import math
from dataclasses import dataclass
from pathlib import Path

from taichi_sph.errors import InputError
from taichi_sph.scene import Scene

DEFAULT_ERROR = 0.1
"""Error that `--model auto` bears, where none is given: what the study of methods resolves."""


@dataclass(frozen=True)
class RunOptions:
    """The options of a run.

    Raises:
        InputError: two of them contradict each other.
    """

    scene: str
    """Name of a shipped scene, a scene's file, or its folder."""
    frames: int | None = None
    """Frames to simulate."""
    until: float | None = None
    """Simulated time to stop at [s]; the scene's duration by default."""
    arch: str = "cpu"
    precision: str = "f32"
    threads: int | None = None
    """CPU threads; all by default."""
    seed: int = 0
    rrd: Path | None = None
    """Rerun file to record to."""
    live: int | None = None
    """Loopback port of a live view."""
    every: int = 1
    """Particles are shown in each so many frames."""
    colour: str = "speed"
    """What blood is coloured by, one of `app.view.appearance.COLOURINGS`."""
    summary: Path | None = None
    """JSON file for the summary."""
    wall_stress: Path | None = None
    """VTK file for the wall shear stress."""
    particles: int | None = None
    """Blood particles, instead of the scene's column."""
    height: float | None = None
    """Height of the column [m], instead of the scene's."""
    model: str = "physics"
    """One of `app.models.MODELS`, or "auto"."""
    error: float | None = None
    """Largest error that `auto` bears."""
    weights: Path | None = None
    """Weights of the network."""
    checkpoint: int | None = None
    """The state of each so many frames is kept."""
    resume: Path | None = None
    """Checkpoint to go on from."""
    script: Path | None = None
    """Commands at simulated times."""
    session: Path | None = None
    """Log of what is done to the run."""
    control: int | None = None
    """Port of the page; the channel is at the next one."""
    host: str = "127.0.0.1"
    """Address of the channel."""

    def __post_init__(self) -> None:
        auto, shown = self.model == "auto", self.rrd is not None or self.live is not None
        for refused, sentence in (
            (self.frames is not None and self.until is not None,
             "--frames and --until: give one of the two"),
            (self.particles is not None and self.height is not None,
             "--particles and --height: give one of the two"),
            (self.every > 1 and not shown, "--every: nothing is shown without --rrd or --live"),
            (self.colour != "speed" and not shown,
             "--colour: nothing is shown without --rrd or --live; the page has its own choice"),
            (self.weights is not None and self.model != "pcnet" and not self.is_acted_on,
             "--weights: only --model pcnet has weights"),
            (auto and (self.resume is not None or self.checkpoint is not None),
             "--checkpoint and --resume: name the model, for auto may choose another"),
            (auto and self.is_acted_on,
             "--model auto: pours a scene first; in a session, switch to auto instead"),
            (self.error is not None and not auto, "--error: only --model auto has a budget"),
            (self.live is not None and self.control is not None
             and self.live in (self.control, self.control + 1),
             f"--live {self.live}: is a port of --control, which takes two; give another"),
        ):  # fmt: skip
            if refused:
                raise InputError(sentence)

    @property
    def is_acted_on(self) -> bool:
        """Whether commands may come to the run."""
        return self.script is not None or self.session is not None or self.control is not None

    def end(self, scene: Scene) -> float:
        """Simulated time to stop at [s]; infinite for a run that is controlled until stopped."""
        if self.until is not None:
            return self.until
        if self.frames is not None:
            return self.frames * scene.frame_interval
        return math.inf if self.control is not None else scene.duration

    def checkpoint_file(self, scene: Scene) -> Path | None:
        """File of the checkpoints, if any are kept."""
        if self.checkpoint is None:
            return None
        return self.resume or Path(f"{scene.name}.checkpoint.npz")

    def session_file(self, scene: Scene) -> Path | None:
        """File of the log, if one is kept.

        Without a name it is the first that is free, for a log is never replaced.
        """
        if self.session is not None or self.control is None:
            return self.session
        file, number = Path(f"{scene.name}.session.jsonl"), 1
        while file.exists() and file.stat().st_size:
            number += 1
            file = Path(f"{scene.name}.{number}.session.jsonl")
        return file
