"""Peers: blood poured by SPH that nobody here wrote, and read as ours is.

SPlisHSPlasH (https://splishsplash.physics-simulation.org, MIT licence) through pysplishsplash.
"""

import ctypes
import importlib.util
import json
import math
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh

from taichi_sph.assemble import OPENING_REACH, SKIN
from taichi_sph.derived import derive
from taichi_sph.diagnostics import Diagnostics, diagnose
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.geometry import mesh
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene

SOLVERS = {"splishsplash-wcsph": 0, "splishsplash-dfsph": 4}
"""Models by name, with SPlisHSPlasH's number of each."""

SETBACK = 0.6
"""How far behind the lumen's surface SPlisHSPlasH's wall stands [spacings].  There it gives the
first layer of blood, half a spacing inside, the density that this misses of a lattice below it.  A
wall on the surface itself would compress that layer by half before the first step."""

DELIVERED = 0.698
"""Part of SPlisHSPlasH's viscosity that a lattice of its particles shows in shear [-]."""

FRICTION = 1.97
"""Viscosity at its wall over that within blood [-]: in shear, blood on a lattice then rests on the
lumen's surface.  With 1 it slips, and a pour's error in energy doubles."""


def has_peer() -> bool:
    """Whether pysplishsplash is installed."""
    return importlib.util.find_spec("pysplishsplash") is not None


def require_peer() -> None:
    """Refuse to go on without pysplishsplash.

    Raises:
        InputError: it is not installed.
    """
    if not has_peer():
        raise InputError("--peer: pysplishsplash is not installed; pip install 'vesselflow[peer]'")


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing goes to the standard output meanwhile, from whatever language."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def begin(scene: dict[str, Any], folder: Path) -> Any:
    """Start SPlisHSPlasH, once a process, on a scene of its own format; returns its simulator.

    Everything is as it reads the scene, but it has taken one step of the scene's size, since it
    loads the wall only then.  It takes as many threads as OMP_NUM_THREADS says.

    Raises:
        RunError: a library of the system is missing.
    """
    for library in ("X11.so.6", "GLdispatch.so.0", "GLX.so.0", "OpenGL.so.0", "GL.so.1"):
        # Its wheel brings a GL that crashes at import unless the system's is there first.
        try:
            ctypes.CDLL(f"lib{library}", mode=ctypes.RTLD_GLOBAL)
        except OSError as error:
            raise RunError(f"--peer: pysplishsplash needs lib{library} ({error})") from None
    import pysplishsplash

    (folder / "peer.json").write_text(json.dumps(scene), encoding="utf-8")
    base = pysplishsplash.Exec.SimulatorBase()
    with quiet():
        base.init(useGui=False, sceneFile=str(folder / "peer.json"), outputDir=str(folder / "out"))
        base.setValueFloat(base.STOP_AT, 1e-12)
        base.initSimulation()
        base.runSimulation()
    return base


def wall_behind(vessel: Vessel, setback: float) -> trimesh.Trimesh:
    """The wall, without open openings, moved out of the lumen by a distance [m]."""
    vertices, faces = mesh.drop_unused(vessel.vertices, vessel.wall_faces)
    area = mesh.face_vectors(vertices, faces)
    normal = mesh.unit(area)
    # At an edge no one normal moves both faces by the setback: a vertex goes where all its faces'
    # planes go, in the sense of least squares weighted by area.
    square = np.zeros((len(vertices), 3, 3))
    right = np.zeros((len(vertices), 3))
    for corner in faces.T:
        np.add.at(square, corner, area[:, :, None] * normal[:, None, :])
        np.add.at(right, corner, setback * area)
    shift = np.linalg.pinv(square, rcond=0.05, hermitian=True) @ right[:, :, None]
    return trimesh.Trimesh(vertices + shift[:, :, 0], faces, process=False)


def rigid_wall(surface: Path) -> dict[str, Any]:
    """A wall of SPlisHSPlasH's scenes: a surface (OBJ) where it is, sampled by Poisson disks."""
    return {
        "geometryFile": str(surface),
        "translation": [0, 0, 0],
        "rotationAxis": [1, 0, 0],
        "rotationAngle": 0,
        "scale": [1, 1, 1],
        "isDynamic": False,
        "isWall": True,
        "samplingMode": 0,
    }


def write_points(path: Path, points: np.ndarray) -> None:
    """Write points (n, 3) as a file of Houdini's, version 5, which SPlisHSPlasH reads."""
    header = struct.pack(">4sc9i", b"Bgeo", b"V", 5, len(points), *[0] * 7)
    homogeneous = np.column_stack([points, np.ones(len(points))]).astype(">f4")
    path.write_bytes(header + homogeneous.tobytes())


class Peer:
    """Blood of a scene in its vessel, moved by SPlisHSPlasH; it is read as a `Simulation` is.

    The column, its mass, the lumen, gravity, sound speed and the support radius are ours; kernel,
    sums, wall and pressure are SPlisHSPlasH's.  Blood is Newtonian.  There is one in a process.
    """

    wall_corrections = 0
    fallback_share = 0.0

    def __init__(self, scene: Scene, solver: str, step_factor: float = 1.0):
        """Set up a solver, one of SOLVERS, to take `step_factor` times its own steps.

        Raises:
            InputError: the surface cannot be used, or the column does not fit.
            RunError: a library of the system is missing.
        """
        vessel = read_vessel(scene)
        d = scene.discretization.spacing
        blood = vessel.fill_column(scene.column, d)
        self.scene, self.vessel, self.solver = scene, vessel, solver
        self.derived = derive(scene, vessel, len(blood), 0)
        self.step_factor = step_factor
        self.time = self.last_step = 0.0
        self.steps = 0
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            wall_behind(vessel, SETBACK * d).export(folder / "wall.obj")
            write_points(folder / "blood.bgeo", blood)
            self._base = begin(self._scene(folder), folder)
        import pysplishsplash

        self._simulation = pysplishsplash.Simulation.getCurrent()
        self._clock = pysplishsplash.TimeManager.getCurrent()
        self._set_aside = pysplishsplash.ParticleState.AnimatedByEmitter
        self._fluid = self._simulation.getFluidModel(0)
        proxies = self._simulation.getBoundaryModel(0).numberOfParticles()
        self.derived = replace(self.derived, proxy_particles=proxies)
        # Views of its memory, whose order it changes now and then.
        self._identity, self._position, self._velocity, self._density = (
            np.asarray(self._fluid.getFieldBuffer(field))[: len(blood)]
            for field in ("id", "position", "velocity", "density")
        )
        self._position[:] = blood[self._identity]
        self._velocity[:] = 0.0
        mass = self._fluid.getMass(0)
        self.particles = SimpleNamespace(count={None: len(blood)}, mass=mass)
        margin = 2.0 * (1.0 + SKIN) * self.derived.support_radius
        self._lower, self._upper = vessel.bounds[0] - margin, vessel.bounds[1] + margin
        self._open = [opening for opening in vessel.openings if opening.is_open]
        normals = np.array([opening.normal for opening in self._open]).reshape(-1, 3)
        centres = np.array([opening.centre for opening in self._open]).reshape(-1, 3)
        self._normals = normals.T.astype(np.float32)
        self._heights = (normals * centres).sum(axis=1).astype(np.float32)
        self._gone = np.zeros(len(blood), bool)
        """By identity."""
        self._drained = {opening.name: 0 for opening in vessel.openings}
        self._lost = 0

    def _scene(self, folder: Path) -> dict[str, Any]:
        """The scene in SPlisHSPlasH's format."""
        scene, d = self.scene, self.scene.discretization.spacing
        # Kinematic [m^2/s] (its issue 169).
        viscosity = scene.blood.rheology.viscosity / scene.blood.density / DELIVERED
        # It has no artificial viscosity.  Monaghan's is this one between approaching particles,
        # which are half of them; without any the blood clumps.
        artificial = 0.05 * scene.blood.artificial_viscosity * self.derived.sound_speed * d
        g = math.hypot(*scene.gravity)
        law = Tait(scene.blood.density, self.derived.sound_speed)
        return {
            "Configuration": {
                "particleRadius": 0.5 * d,
                "simulationMethod": SOLVERS[self.solver],
                "gravitation": list(scene.gravity),
                "boundaryHandlingMethod": 0,  # Akinci et al. 2012
                "timeStepSize": 1e-9,
                "cflMethod": 0,  # each step is given, so that frames end on time
                "cflFactor": self.step_factor,
                "cflMinTimeStepSize": 1e-8,
                "cflMaxTimeStepSize": 0.25 * math.sqrt(d / g) if g else scene.frame_interval,
                "WCSPH": {
                    "stiffness": law.stiffness,
                    "exponent": float(law.exponent),
                },
            },
            "Materials": [
                {
                    "id": "Fluid",
                    "density0": scene.blood.density,
                    "viscosityMethod": 1,
                    "Standard viscosity": {
                        "viscosity": viscosity + artificial,
                        "viscosityBoundary": FRICTION * viscosity,
                    },
                }
            ],
            "FluidModels": [
                {
                    "id": "Fluid",
                    "particleFile": str(folder / "blood.bgeo"),
                    "translation": [0, 0, 0],
                    "rotationAxis": [1, 0, 0],
                    "rotationAngle": 0,
                    "scale": [1, 1, 1],
                }
            ],
            "RigidBodies": [rigid_wall(folder / "wall.obj")],
        }

    def _stable_step(self) -> float:
        """WCSPH: our physics' step at the expected speed; DFSPH: its own Courant condition [s]."""
        if self.solver == "splishsplash-wcsph":
            return self.step_factor * self.derived.step
        self._simulation.updateTimeStepSizeCFL()
        return self._clock.getTimeStepSize()

    def advance_to(self, time: float) -> None:
        """Step until a simulated time [s].

        Raises:
            RunError: a state that is not finite, or faster than sound.
        """
        solver = self._simulation.getTimeStep()
        while self.time < time * (1.0 - 1e-12) and self.particles.count[None] > 0:
            remaining = time - self.time
            # Equal steps to the end of the frame, as ours.
            stable = self._stable_step() * (1.0 + 1e-9)
            self.last_step = remaining / max(1, math.ceil(remaining / stable))
            self._clock.setTimeStepSize(self.last_step)
            solver.step()
            self.time += self.last_step
            self.steps += 1
            self._remove()
        self.time = time
        x = self._position
        outside = ((x < self._lower) | (x > self._upper)).any(axis=1)
        self._lost += self._put_aside(np.flatnonzero(outside & ~self._gone[self._identity]))

    def _remove(self) -> None:
        """Set aside what has left through an open opening.

        SPlisHSPlasH cannot remove a particle: one that has left stands still, alone and far off.

        Raises:
            RunError: a state that is not finite, or faster than sound.
        """
        limit = self.derived.sound_speed
        fastest = math.sqrt(float(np.einsum("ij,ij->i", self._velocity, self._velocity).max()))
        if not fastest < limit:  # nor a number
            raise RunError(
                f"the run diverged: a speed of {fastest:.3g} m/s, above the limit of {limit:.3g} "
                f"m/s, at t = {self.time:.6g} s, step {self.steps}"
            )
        rows, which = np.nonzero(self._position @ self._normals > self._heights)
        there = ~self._gone[self._identity[rows]]
        for k, opening in enumerate(self._open):
            beyond = rows[there & (which == k)]
            away = np.linalg.norm(self._position[beyond] - opening.centre, axis=1)
            left = beyond[away < OPENING_REACH * opening.radius]
            self._drained[opening.name] += self._put_aside(left)

    def _put_aside(self, rows: np.ndarray) -> int:
        """Take particles out of the flow; returns how many."""
        for row in rows:
            identity = self._identity[row]
            self._gone[identity] = True
            self._fluid.setParticleState(int(row), self._set_aside)
            alone = 2.0 * self.derived.support_radius * (1 + identity)
            self._position[row] = self._upper + 1.0 + np.array([alone, 0.0, 0.0])
            self._velocity[row] = 0.0
        self.particles.count[None] -= len(rows)
        return len(rows)

    def _in_order(self, field: np.ndarray) -> np.ndarray:
        """Copy of the rows of the blood that is there, by identity."""
        return field[np.argsort(self._identity)][~self._gone]

    def positions(self) -> np.ndarray:
        """Positions of the live blood [m], shape (n, 3), in order of identity."""
        return self._in_order(self._position)

    def velocities(self) -> np.ndarray:
        """Velocities of the live blood [m/s], shape (n, 3), in order of identity."""
        return self._in_order(self._velocity)

    def diagnostics(self) -> Diagnostics:
        """Figures of the present state; densities are SPlisHSPlasH's own.

        Blood leaks where it is further out than its wall stands.
        """
        setback = SETBACK * self.scene.discretization.spacing
        leaks = self.vessel.count_leaks(self.positions(), setback) + self._lost
        return diagnose(self, self._in_order(self._density), dict(self._drained), leaks)
