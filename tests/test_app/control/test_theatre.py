"""The page in a real browser, commanding a real simulation: what is done is seen in the blood."""

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from app.control.auto_model import ModelSelection
from app.control.log import LogWriter
from app.control.page import ControlPage
from app.control.ports import listen
from app.control.session import Session
from app.models import MODELS
from browser import Browser, needs_viser
from fake_session import wait_until
from taichi_sph.scene import read_scene
from taichi_sph.simulation import Simulation


class Theatre:
    """A session that goes on in a thread of its own, frame by frame, until it is closed."""

    def __init__(self, folder: Path):
        scene = read_scene(folder / "scene.toml")
        self.simulation = Simulation.from_scene(scene)
        models = ModelSelection(self.simulation, MODELS)
        log = LogWriter(folder / "theatre.jsonl", {}, self.simulation.particles.names)
        self.session = Session(self.simulation, models, log)
        self.closing = False
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        simulation, frame = self.simulation, 0
        while not self.closing:
            self.session.on_frame(simulation, frame, simulation.diagnostics())
            frame += 1
            simulation.advance_to(frame * simulation.scene.frame_interval, self.session.before_step)

    def close(self) -> None:
        self.closing = True
        self.session.submit({"command": "speed"}, "test")
        self.session.submit({"command": "pause", "on": False}, "test")
        self.thread.join()
        self.session.close("tested")


@pytest.fixture
def theatre(driven: Path) -> Iterator[Theatre]:
    made = Theatre(driven)
    yield made
    made.close()


@pytest.mark.validation
@needs_viser
def test_every_control_of_the_page_is_seen_in_the_simulation(theatre: Theatre) -> None:
    pytest.importorskip("selenium", reason="selenium is not installed")
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    simulation, session = theatre.simulation, theatre.session
    scene, tool, suction = simulation.scene, simulation.tool, simulation.suction
    page = ControlPage(session, listen("127.0.0.1", 0, "page"))
    session.on_rejected.append(page.tell)
    browser = Browser(page, np.asarray(simulation.vessel.vertices, float), scene.gravity)
    try:
        wait_until(
            lambda: browser.driver.find_elements("xpath", "//*[contains(., 'Software')]//button")
        )
        browser.find("//*[contains(., 'Software')]//button[1]").click()
        browser.press("hold")
        wait_until(lambda: session.paused)
        wait_until(lambda: getattr(session.latest_frame(None), "time", None) == simulation.time)
        steps = simulation.steps
        browser.press("one step")
        wait_until(lambda: simulation.steps == steps + 1)
        browser.find("//td[.='held']")
        browser.choose("model", "implicit")
        wait_until(lambda: simulation.model.name == "implicit")
        browser.choose("model", "auto")
        wait_until(lambda: session.models.auto and simulation.model.name == "pcnet")

        browser.enter("right [deg]", 90)
        wait_until(lambda: abs(simulation.gravity[2]) < 1e-6)
        assert np.linalg.norm(simulation.gravity) == pytest.approx(9.81)
        browser.enter("top", 0.5)
        wait_until(lambda: [o.target_factor for o in simulation.inflow.openings] == [0.5, 1.0])
        place = tool.target_position
        right = page.right
        browser.pull(page.tool_handle, np.eye(3)[int(np.abs(right).argmax())])
        wait_until(lambda: not np.array_equal(tool.target_position, place))
        browser.enter("rate [ml/min]", 120)
        browser.find('//label[.="suction"]/following::input[1]').click()
        wait_until(lambda: suction.rate == pytest.approx(2e-6))
        browser.find('//label[.="suction"]/following::input[1]').click()
        wait_until(lambda: suction.rate == 0.0)

        browser.press("Wound here")
        wait_until(lambda: len(simulation.wounds))
        browser.enter("speed limit", 0.5)
        wait_until(lambda: session.speed == 0.5)
        browser.press("go on")
        wait_until(lambda: not session.paused)
        wait_until(lambda: simulation.steps > steps + 20)
        wait_until(lambda: session.status()["lost"] > 0.0, patience=60.0)
        browser.find("//td[.='lost blood']/following::td[1][not(.='0.00 ml')]")
        browser.press("Clamp")
        wait_until(lambda: not next(iter(simulation.wounds)).is_open)
        browser.press("reset")
        wait_until(lambda: not len(simulation.wounds))
        wait_until(lambda: simulation.gravity == scene.gravity)
    finally:
        browser.driver.quit()
        page.close()
