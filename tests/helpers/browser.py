"""The control page in headless Chromium."""

import math
import shutil
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from app.control import page as page_module
from app.control.page import ControlPage
from app.view.appearance import FIELD_OF_VIEW, eye, upward
from fake_session import PATIENCE, wait_until

needs_viser = pytest.mark.skipif(
    page_module.importlib.util.find_spec("viser") is None, reason="viser is not installed"
)


class Browser:
    """Chromium without a window, and hands."""

    def __init__(self, page: ControlPage, vertices: np.ndarray, gravity: Any):
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = str(shutil.which("chromium"))
        for argument in (
            "headless=new", "no-sandbox", "disable-dev-shm-usage", "window-size=900,700",
            "use-angle=swiftshader", "enable-unsafe-swiftshader",
        ):  # fmt: skip
            options.add_argument(f"--{argument}")
        service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
        self.driver = webdriver.Chrome(options, service)
        self.driver.get(page.url)
        self.look = (*eye(vertices, upward(gravity)), upward(gravity))
        self.find("//*[.='bleeding']")

    def find(self, path: str) -> Any:
        """The first element that an XPath names; waits for it."""
        return wait_until(lambda: self.driver.find_elements("xpath", path), 3 * PATIENCE)[0]

    def act(self, path: str, deed: Callable[[Any], object]) -> None:
        """Do something to an element; again where the page has drawn it anew meanwhile."""
        from selenium.common.exceptions import StaleElementReferenceException

        for _ in range(10):
            try:
                deed(self.find(path))
                return
            except StaleElementReferenceException:
                time.sleep(0.1)
        raise AssertionError(f"{path} is drawn anew again and again")

    def press(self, button: str) -> None:
        self.act(f"//button[.='{button}']", lambda found: found.click())

    def enter(self, label: str, value: float) -> None:
        from selenium.webdriver.common.keys import Keys

        path = f'//label[.="{label}"]/following::input[@inputmode="decimal"][1]'
        keys = (Keys.CONTROL, "a", Keys.NULL, str(value), Keys.TAB)
        self.act(path, lambda found: found.send_keys(*keys))
        # The page tells of changes each 50 ms, and of the last one only: no hand is as quick.
        time.sleep(0.2)

    def choose(self, label: str, option: str) -> None:
        self.act(f'//label[.="{label}"]/following::input[1]', lambda found: found.click())
        self.act(f"//*[@role='option'][.='{option}']", lambda found: found.click())

    def pixel(self, point: np.ndarray) -> tuple[int, int]:
        """Where a point [m] is on the page, as long as the camera stands as at the start."""
        position, target, up = self.look
        back = (position - target) / np.linalg.norm(position - target)
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        way = point - position
        canvas = self.find("//canvas").rect
        scale = 0.5 * canvas["height"] / math.tan(0.5 * FIELD_OF_VIEW) / -(way @ back)
        x = canvas["x"] + 0.5 * canvas["width"] + scale * (way @ right)
        y = canvas["y"] + 0.5 * canvas["height"] - scale * (way @ np.cross(back, right))
        return round(x), round(y)

    def corner(self) -> tuple[int, int]:
        """A pixel beside the vessel."""
        canvas = self.find("//canvas").rect
        return round(canvas["x"]) + 10, round(canvas["y"] + canvas["height"]) - 10

    def drag(self, *pixels: tuple[int, int]) -> None:
        """Press at the first, let go at the last."""
        from selenium.webdriver.common.action_chains import ActionBuilder

        for k, (x, y) in enumerate(pixels):
            actions = ActionBuilder(self.driver, duration=20)
            pointer = actions.pointer_action
            pointer.move_to_location(x, y)
            pointer.pause(0.2)
            if k == 0:
                pointer.pointer_down()
            if k == len(pixels) - 1:
                pointer.pointer_up()
            actions.perform()

    def pull(self, gizmo: Any, axis: np.ndarray) -> None:
        """Take the arrow of a gizmo and draw it along."""
        start, length = np.array(gizmo.position), gizmo.scale
        self.drag(*(self.pixel(start + f * length * axis) for f in (0.6, 0.7, 0.9, 1.1)))
