"""What a library's user may get wrong in a process: two starts, forks, threads; a sentence each.

Each program would end by a signal or hang without it, so that it has a process of its own.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from places import ROOT

PATIENCE = 120.0
"""Longest that a busy machine may take to compile a step [s]; a hang lasts for ever."""

MADE = """
import os, sys, threading
from pathlib import Path
import numpy as np
from app.validation.flows import Liquid, box
from taichi_sph import InputError, RunError, Simulation, read_scene, start
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.particles.particles import Particles

def make():
    return box(Liquid(Newtonian(3.5e-3), 1.0, 1e-3), (10, 10, 10), np.zeros_like)

def say(call):
    try:
        call()
        print("done")
    except (InputError, RunError) as error:
        print(error)
"""
"""A small simulation without a scene, which takes seconds less."""

AGAIN = "this simulation was made before the last start(), which freed its fields; make it again"
FORKED = "this process was forked after start(), and Taichi's threads were not copied; fork before"
THREAD = "start() was called in another thread: make simulations and models in the thread that"


def run(program: str, folder: Path) -> list[str]:
    """Lines that a program says; it must end, and well."""
    file = folder / "program.py"  # Taichi reads sources from files
    file.write_text(MADE + program)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "ENABLE_TAICHI_HEADER_PRINT": "0"}
    done = subprocess.run(
        [sys.executable, str(file)], env=environment, capture_output=True, text=True,
        timeout=PATIENCE,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_what_was_made_before_the_last_start_is_refused_and_the_next_one_works(tmp_path):
    lines = run(
        """
start()
old = make()
fields = Particles.from_numpy(np.zeros((4, 3)))
start()
arrays = np.zeros(4, np.int32), np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32)
for call in (
    lambda: old.advance_to(1e-4), lambda: old.step(1.0), old.rebuild_lists, old.positions,
    old.velocities, old.positions_and_velocities, old.identities, old.save_state,
    old.diagnostics, lambda: old.outlets, lambda: old.inflow, lambda: old.wounds,
    lambda: old.restart_with(np.zeros((1, 3)), np.zeros((1, 3))), lambda: old.compile_kernels([]),
    fields.live, fields.identities, fields.rows, lambda: fields.copy_to(*arrays),
    lambda: fields.in_order(fields.density),
):
    say(call)
new = make()
say(lambda: new.step(1e-5))
""",
        tmp_path,
    )
    assert len(lines) == 20
    assert all(line.startswith(AGAIN) for line in lines[:-1]), lines
    assert lines[-1] == "done"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing forks here")
def test_a_fork_says_so_ends_and_leaves_its_parent_alone(tmp_path):
    lines = run(
        """
start()
sim = make()
sim.step(1e-5)
sys.stdout.flush()
child = os.fork()
if child == 0:
    for call in (lambda: sim.step(1e-5), sim.positions, start, make):
        say(call)
    sys.exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
say(lambda: sim.step(1e-5))
""",
        tmp_path,
    )
    assert len(lines) == 6
    assert all(line.startswith(FORKED) for line in lines[:4]), lines
    assert lines[4:] == ["7", "done"]


def test_a_simulation_runs_in_any_thread_and_is_made_in_that_of_start(tmp_path):
    lines = run(
        """
def elsewhere(call):
    thread = threading.Thread(target=say, args=(call,))
    thread.start()
    thread.join()

say(make)
elsewhere(start)
say(make)
start()
sim = make()
elsewhere(lambda: sim.advance_to(1e-4))
elsewhere(make)
say(lambda: sim.advance_to(2e-4))
""",
        tmp_path,
    )
    assert lines[0] == "call taichi_sph.start() first: nothing can be computed before it"
    assert lines[1] == "done"
    assert lines[2].startswith(THREAD)
    assert lines[3] == "done", "made here, first step there"
    assert lines[4].startswith(THREAD)
    assert lines[5:] == ["done"]
