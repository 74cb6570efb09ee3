"""A surgery simulator's loop in small: blood, a wound, a tool's force, a clamp.

    python docs/engine.py SCENE.toml [WEIGHTS.npz [SECONDS]]

Every frame it asks for what an engine draws and feels, into arrays that it owns.
"""

import sys
from pathlib import Path

import numpy as np

from nn import load_pcnet
from taichi_sph import Simulation, float_dtype, implicit, read_scene, start

scene = read_scene(Path(sys.argv[1]))
seconds = float(sys.argv[3]) if len(sys.argv) > 3 else 0.2
model = load_pcnet(Path(sys.argv[2]), scene) if len(sys.argv) > 2 else implicit(scene)
start(arch="cpu")
simulation = Simulation.from_scene(scene, model)
simulation.compile_kernels([simulation.model])  # compile now, not when it is needed

room = simulation.particles.capacity
identity = np.zeros(room, np.int32)
position, velocity = np.zeros((2, room, 3), float_dtype())

# A place on the wall half way along, and one inside for the tool.
vertices = simulation.vessel.vertices
wall = vertices[np.argmin(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1))]
radius = 2.5 * scene.discretization.spacing

before = simulation.diagnostics()
frame_interval = scene.frame_interval
for frame in range(1, round(seconds / frame_interval) + 1):
    if frame == 3:
        simulation.wounds.open(wall, radius)
        simulation.tool.move_to(wall)
        simulation.suction.set(rate=1e-6)  # m^3/s
    if frame == 8:
        simulation.wounds.close()
        simulation.suction.set(rate=0.0)
    simulation.advance_to(frame * frame_interval)
    count = simulation.particles.copy_to(identity, position, velocity)
    # Draw position[:count], colour by velocity[:count], follow particles by identity[:count],
    # draw simulation.outlets.droplets() outside; feed the hand with the force:
    force = simulation.tool.take_force()
    figures = simulation.diagnostics()
    events = {
        "bled": figures.bled_volume - before.bled_volume,
        "sucked": figures.sucked_volume - before.sucked_volume,
        "drained": figures.drained_volume - before.drained_volume,
    }
    before = figures
    happened = ", ".join(f"{name} {1e9 * volume:.2f} ul" for name, volume in events.items())
    print(
        f"{figures.time:.3f} s: {count} particles, fastest {figures.max_speed:.2f} m/s, "
        f"{happened}, force {1e3 * np.linalg.norm(force):.2f} mN"
    )
