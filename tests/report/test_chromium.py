"""The page in a real browser: it opens from disk, plays, and asks nobody for anything."""

import io
import time

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select, WebDriverWait

from gns_pyg.report.player import ASSETS, player
from tests import scenes
from tests.report.chromium import chromium, complaints, needs_chromium, requests
from tests.report.test_player import result

pytestmark = [pytest.mark.chromium, needs_chromium]
N_FRAMES = 9


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as browser:
        browser.set_script_timeout(60)
        yield browser


class Player:
    """The player of the page that a browser shows."""

    def __init__(self, browser, page):
        requests(browser), complaints(browser)  # of the page before
        browser.get(f"file://{page}")
        self.browser = browser
        self.root = browser.find_element(By.ID, "player")
        self.wait(lambda: self.root.get_attribute("data-drawn"))

    def part(self, selector):
        return self.root.find_element(By.CSS_SELECTOR, selector)

    def wait(self, condition):
        return WebDriverWait(self.browser, 60).until(lambda _: condition())

    def drawn(self):
        return int(self.root.get_attribute("data-drawn"))

    def frame(self):
        return int(self.root.get_attribute("data-frame"))

    def change(self, selector, value, event="input"):
        """Sets a control as a hand would and waits for the drawing that follows."""
        before = self.drawn()
        order = "const [c, v, e] = arguments; c.value = v; c.dispatchEvent(new Event(e))"
        self.browser.execute_script(order, self.part(selector), value, event)
        self.wait(lambda: self.drawn() > before)

    def picture(self):
        """What the two views show, (2, height, width, 3)."""
        image = np.asarray(Image.open(io.BytesIO(self.part("canvas").screenshot_as_png)).convert("RGB"), float)
        half = image.shape[1] // 2
        return np.stack([image[:, :half], image[:, -half:]])


def page(tmp_path, simulated, pos, dem_pos=None):
    path = tmp_path / "page.html"
    style = (ASSETS / "page.css").read_text()
    content = player(result(pos, dem_pos), simulated)
    path.write_text(f'<!DOCTYPE html><meta charset="utf-8"><style>{style}</style>{content}', encoding="utf-8")
    return path


def middle(view):
    """Where the coloured part of a view is, pixels (x, y): grains are, walls and labels are grey."""
    there = np.ptp(view, axis=2) > 40
    assert there.any(), "no grain is drawn"
    y, x = np.nonzero(there)
    return np.array([x.mean(), y.mean()])


@pytest.fixture
def one_grain(browser, tmp_path):
    """A grain that rests in DEM and moves evenly along x in the network, in a box."""
    box = {"kind": "box", "size_m": [0.3, 0.3, 0.3], "center_m": [0.0, 0.0, 0.0]}
    boundary = {"walls": {"shape": box, "points": 50, "friction_angle_rad": 0.5}}
    dem_pos = np.zeros((N_FRAMES, 1, 3))
    pos = dem_pos.copy()
    pos[:, 0, 0] = np.linspace(0, 0.12, N_FRAMES)
    return Player(browser, page(tmp_path, scenes.scene(1, N_FRAMES, boundary=boundary), pos, dem_pos))


def test_a_page_opens_from_disk_without_a_complaint_or_a_request(one_grain):
    assert one_grain.root.get_attribute("data-state") == "ready"
    assert one_grain.frame() == 0
    assert [one_grain.part(f".{side}").text for side in ("left", "right")] == ["DEM (Yade)", "network"]
    assert complaints(one_grain.browser) == []
    assert requests(one_grain.browser) == []


def test_the_log_would_tell(browser):
    """That the two checks above can fail."""
    browser.get("data:text/html,<script src='http://127.0.0.1:9/x.js'></script>")
    time.sleep(1)
    assert any("127.0.0.1" in url for url in requests(browser))
    assert complaints(browser)


def test_frames_advance_while_playing_and_stop_when_paused(one_grain):
    Select(one_grain.part(".rate")).select_by_index(3)
    one_grain.part(".play").click()
    seen = {one_grain.frame()}
    one_grain.wait(lambda: seen.add(one_grain.frame()) or len(seen) > 2)
    one_grain.part(".play").click()
    time.sleep(0.5)
    stopped = one_grain.drawn(), one_grain.part(".time").text
    time.sleep(0.5)
    assert (one_grain.drawn(), one_grain.part(".time").text) == stopped
    assert complaints(one_grain.browser) == []


def test_scrubbing_shows_grains_where_they_are(one_grain):
    places = []
    for frame in (0, N_FRAMES // 2, N_FRAMES - 1):
        one_grain.change(".frame", frame)
        assert one_grain.frame() == frame
        assert one_grain.part(".time").text == f"{0.01 * frame:.3f} s, frame {frame + 1} of {N_FRAMES}"
        places.append([middle(view) for view in one_grain.picture()])
    dem, network = np.array(places).transpose(1, 0, 2)
    assert np.ptp(dem, axis=0).max() < 1, "DEM's grain rests"
    first, second = np.diff(network, axis=0)
    assert np.hypot(*first) > 20, "the network's grain moves"
    np.testing.assert_allclose(first, second, atol=1.5)


def test_colour_modes_switch(one_grain):
    one_grain.change(".frame", 4)
    pictures, legends = [], []
    for number, unit in enumerate(("speed (m/s)", "distance from DEM (mm)", "coordination number")):
        before = one_grain.drawn()
        Select(one_grain.part(".mode")).select_by_index(number)
        if number:
            one_grain.wait(lambda before=before: one_grain.drawn() > before)
        assert one_grain.part(".ramp").text == unit
        pictures.append(one_grain.picture())
        legends.append(one_grain.part(".ticks").text)
    assert np.abs(pictures[0] - pictures[1]).max() > 40
    assert np.abs(pictures[1][1] - pictures[2][1]).max() > 40
    assert len(set(legends)) == 3


def test_a_slice_takes_away_what_is_nearer(one_grain):
    Select(one_grain.part(".slice")).select_by_value("2")
    one_grain.change(".depth", 0.9)
    assert middle(one_grain.picture()[0]).shape == (2,)
    one_grain.change(".depth", 0.1)  # seen from above: all above the plane is cut away, the grain with it
    assert not (np.ptp(one_grain.picture()[0], axis=2) > 40).any()


def test_both_views_turn_together(one_grain):
    before = one_grain.picture()
    order = """
      const [canvas] = arguments, box = canvas.getBoundingClientRect();
      const at = (kind, x, y) => canvas.dispatchEvent(new PointerEvent(kind, {
        pointerId: 1, pointerType: "mouse", button: 0, buttons: 1, bubbles: true,
        clientX: box.x + x, clientY: box.y + y }));
      canvas.setPointerCapture = canvas.releasePointerCapture = () => {};
      at("pointerdown", 100, 100); at("pointermove", 180, 120); at("pointerup", 180, 120);
    """
    drawn = one_grain.drawn()
    one_grain.browser.execute_script(order, one_grain.part("canvas"))
    one_grain.wait(lambda: one_grain.drawn() > drawn)
    after = one_grain.picture()
    assert all(np.abs(view - old).max() > 20 for view, old in zip(after, before, strict=True))
    np.testing.assert_allclose(middle(after[0]), middle(after[1]), atol=2)  # the same place at the start
    assert complaints(one_grain.browser) == []


def test_scrolling_passes_by_until_the_player_is_clicked(one_grain):
    order = """
      const [canvas, clicked] = arguments;
      canvas.setPointerCapture = canvas.releasePointerCapture = () => {};
      const mouse = { pointerId: 1, pointerType: "mouse", button: 0, bubbles: true };
      if (clicked) ["pointerdown", "pointerup"].forEach((kind) => canvas.dispatchEvent(new PointerEvent(kind, mouse)));
      return canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 100, bubbles: true, cancelable: true }));
    """
    canvas = one_grain.part("canvas")
    assert one_grain.browser.execute_script(order, canvas, False), "the page may scroll"
    assert not one_grain.browser.execute_script(order, canvas, True), "the player takes it"


def test_moving_walls_turn(browser, tmp_path):
    """The grain is at rest, so what changes is the wall; after a quarter turn a square box stands as before."""
    motion = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": np.pi / 2 / 0.08}
    box = {"kind": "box", "size_m": [0.3, 0.3, 0.3]}
    boundary = {"drum": {"shape": box, "points": 50, "friction_angle_rad": 0.5, "motion": motion}}
    turning = Player(browser, page(tmp_path, scenes.scene(1, 9, boundary=boundary), np.zeros((9, 1, 3))))
    pictures = []
    for frame in (0, 4, 8):
        turning.change(".frame", frame)
        pictures.append(turning.picture())
    assert np.abs(pictures[0] - pictures[1]).mean() > 4 * np.abs(pictures[0] - pictures[2]).mean()
    assert np.abs(pictures[0] - pictures[1]).max() > 40


def test_a_browser_that_cannot_play_says_so(browser, tmp_path):
    path = page(tmp_path, scenes.scene(1, 3), np.zeros((3, 1, 3)))
    old = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script>"
    path.write_text(path.read_text().replace("<style>", old + "<style>", 1))
    browser.get(f"file://{path}")
    root = browser.find_element(By.ID, "player")
    WebDriverWait(browser, 60).until(lambda _: root.get_attribute("data-state") == "refused")
    assert "no WebGL" in root.text
