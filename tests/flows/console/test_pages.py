"""The console's pages in a real browser, served by the real door."""

import http.client
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.browser import Visit, visited
from tests.conftest import ROOT
from tests.flows.console.stores import HOSTILE, HTML, OWN, add_sweep, hostile_store
from tests.flows.console.test_camera import still_hopper
from tests.flows.pipeline.toys import wait_for

pytestmark = pytest.mark.slow(10)

LONG = 60_000  # milliseconds for what takes one second on a computer that has nothing else to do
SCENE = ".scene[data-steps]"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = hostile_store(tmp_path_factory.mktemp("console") / "runs")
    add_sweep(made)
    return made.root


@contextmanager
def served(*words: str, **environment: str) -> Iterator[str]:
    """The address of a console."""
    command = [sys.executable, "-W", "ignore", "-m", "flows.console", *words]
    own = os.environ | environment
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=own) as server:
        assert server.stdout is not None
        try:
            said = server.stdout.readline()
            assert said.startswith("Open http://127.0.0.1:"), said
            yield said.split()[1].rstrip("/")
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def address(store: Path) -> Iterator[str]:
    with served(f"store={store}") as own:
        yield own


@contextmanager
def operating(address: str, policy: str, width: int = 1400) -> Iterator[Visit]:
    """A window in which a policy runs."""
    with visited(f"{address}/?policy={policy}", width) as visit:
        visit.page.wait_for_selector(SCENE, timeout=LONG)
        yield visit
        assert [said for said in visit.complaints if not said.startswith("log")] == []
        host = urlsplit(address).netloc
        assert {urlsplit(url).netloc for url in visit.requests} <= {host, ""}


def steps(page: Page) -> int:
    return int(page.locator(SCENE).get_attribute("data-steps") or 0)


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name)


def turn(page: Page, proximity: float) -> None:
    """Click into the slider."""
    box = page.locator(".dial .q-slider").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + proximity * box["width"], box["y"] + box["height"] / 2)


def get(address: str, path: str, **headers: str) -> tuple[int, str]:
    """An answer to a request with headers, which a browser would not let a page set."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=60)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def windows(address: str) -> int:
    return int(json.loads(get(address, "/windows")[1])["windows"])


@pytest.mark.parametrize("width", [390, 1400])
def test_turning_the_slider_moves_the_machine(width: int, address: str) -> None:
    with operating(address, "world", width) as visit:
        page = visit.page
        turn(page, 0.9)
        expect(page.locator(".reading")).to_have_text("λ = 0.90", timeout=LONG)
        before = steps(page)
        wait_for(lambda: steps(page) > before + 30, "thirty steps")
        expect(page.locator(".gauge .value.good")).to_be_visible(timeout=LONG)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width  # nothing sticks out of a phone
        button(page, "Pause").click()
        expect(button(page, "Go on")).to_be_visible(timeout=LONG)


def test_leaving_the_log_is_warned_of_and_a_setpoint_is_demanded(address: str) -> None:
    with operating(address, "turbine") as visit:
        page = visit.page
        expect(page.locator(".warning")).to_be_hidden()
        turn(page, 0.97)
        expect(page.locator(".warning")).to_contain_text("has left the log", timeout=LONG)
        page.get_by_label("setpoint").fill("55")
        button(page, "Reset").click()
        expect(page.locator(".clock")).to_contain_text("episode 1", timeout=LONG)


def test_a_setpoint_outlives_the_choice_of_another_policy(address: str) -> None:
    with operating(address, "turbine") as visit:
        page, setpoint = visit.page, visit.page.get_by_label("setpoint")
        setpoint.fill("55")
        for other in ("world", HTML):  # without a setpoint, and with one
            page.locator(".choice").click()
            page.locator(".q-menu").get_by_text(other, exact=other == HTML).first.click()
            expect(setpoint).to_be_visible(visible=other == HTML, timeout=LONG)
        expect(setpoint).to_have_value("55")
        before = steps(page)
        wait_for(lambda: steps(page) > before + 5, "the machine to run")


def test_windows_do_not_disturb_each_other_and_a_closed_one_is_forgotten(address: str) -> None:
    wait_for(lambda: windows(address) == 0, "the windows of other tests to be forgotten")
    with operating(address, "world") as first:
        page = first.page
        turn(page, 0.75)
        expect(page.locator(".reading")).to_have_text("λ = 0.75", timeout=LONG)
        other = page.context.browser.new_page()  # type: ignore[union-attr]
        other.goto(f"{address}/?policy=turbine")
        other.wait_for_selector(SCENE, timeout=LONG)
        expect(other.locator(".reading")).to_have_text("λ = 0.00")
        assert windows(address) == 2
        turn(other, 0.25)
        expect(other.locator(".reading")).to_have_text("λ = 0.25", timeout=LONG)
        expect(page.locator(".reading")).to_have_text("λ = 0.75")
        before = steps(page)
        other.close()  # as a tab that is killed: nothing says goodbye
        wait_for(lambda: windows(address) == 1, "the closed window to be forgotten")
        wait_for(lambda: steps(page) > before + 5, "the other one to go on")
    wait_for(lambda: windows(address) == 0, "all windows to be forgotten")


def test_a_thousand_quick_turns_leave_the_machine_running(address: str) -> None:
    with operating(address, "world") as visit:
        page = visit.page
        box = page.locator(".dial .q-slider").bounding_box()
        assert box is not None
        height = box["y"] + box["height"] / 2
        page.mouse.move(box["x"] + 20, height)
        page.mouse.down()
        for number in range(1000):
            page.mouse.move(box["x"] + box["width"] * (number % 100) / 100, height)
        page.mouse.move(box["x"] + box["width"] / 2, height)
        page.mouse.up()
        expect(page.locator(".reading")).to_have_text("λ = 0.50", timeout=LONG)
        before = steps(page)
        wait_for(lambda: steps(page) > before + 10, "ten steps")


def test_an_own_log_without_a_system_is_shown_on_recorded_states(address: str) -> None:
    with operating(address, OWN) as visit:
        expect(visit.page.locator(".said")).to_contain_text("shown on recorded states")
        expect(visit.page.locator(".legend")).to_contain_text("what was logged")
        expect(visit.page.get_by_text("reward so far: this policy")).to_be_hidden()
        expect(visit.page.get_by_text("action: distance to the familiar")).to_be_visible()


def test_what_a_hostile_card_says_is_text(address: str) -> None:
    with operating(address, HOSTILE) as visit:
        page = visit.page
        expect(page.locator(".choice")).to_contain_text(HTML)
        page.locator(".choice").click()
        expect(page.locator(".q-menu")).to_contain_text("lion/huge/seed0", timeout=LONG)
        assert page.title() == "Operator's console"
        assert page.locator("img[src=x]").count() == 0


@pytest.mark.parametrize(
    "path",
    [
        "/?policy=../../../etc/passwd",
        "/?policy=%2e%2e%2f%2e%2e%2fetc%2fpasswd",
        "/sweep?name=../nodes",
        "/sweep?name=<script>alert(1)</script>",
    ],
)
def test_an_address_that_names_nothing_is_answered_in_a_sentence(path: str, address: str) -> None:
    with visited(f"{address}{path}") as visit:
        expect(visit.page.locator(".said")).to_contain_text("There is no such", timeout=LONG)
        assert "root:" not in visit.page.content()
        assert not [said for said in visit.complaints if "rror" in said]


@pytest.mark.parametrize(
    "path",
    [
        "/document?name=../../reports/secret.txt",
        "/document?name=report+../secret.txt",
        "/document?name=/etc/passwd",
        "/../../../../etc/passwd",
        "/_nicegui/../../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/sessions",
        "/openapi.json",
    ],
)
def test_no_file_is_served_that_is_not_a_report(path: str, address: str) -> None:
    status, text = get(address, path)
    assert status in (404, 200)
    assert "secret" not in text
    assert "root:" not in text
    assert status == 404 or "no such" in text or "404" in text


def test_pages_of_other_sites_are_refused(address: str) -> None:
    here = urlsplit(address).netloc
    assert get(address, "/windows")[0] == 200
    assert get(address, "/windows", Origin=address)[0] == 200
    assert get(address, "/windows", Host="evil.example")[0] == 403
    assert get(address, "/windows", Origin="http://evil.example")[0] == 403
    assert get(address, "/windows", Host=here, Origin="null")[0] == 403
    socket = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert get(address, socket, Origin="http://evil.example")[0] == 403


def test_a_session_that_is_saved_replays_to_the_byte(address: str, store: Path) -> None:
    with operating(address, "world") as visit:
        turn(visit.page, 0.8)
        before = steps(visit.page)
        wait_for(lambda: steps(visit.page) > before + 20, "twenty steps")
        button(visit.page, "Save the session").click()
        expect(visit.page.locator(".said")).to_contain_text("Saved:", timeout=LONG)
    [saved] = (store / "sessions").iterdir()
    words = [sys.executable, "-m", "flows.console", f"replay={saved}", f"store={store}"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "replayed, to the same bytes" in done.stdout


def test_a_sweep_is_watched_and_its_cells_opened(address: str) -> None:
    with visited(f"{address}/sweep?name=small", 390) as visit:
        page = visit.page
        expect(page.locator(".cell.done")).to_have_text("1/1", timeout=LONG)
        expect(page.locator(".cell:not(.done)")).to_have_text("0/1")
        expect(page.locator("table.cells")).to_contain_text("<b>toy</b>")
        expect(page.get_by_text("report small")).to_be_visible()
        page.locator(".cell.done").click()
        expect(page.locator(".heading")).to_have_text("bc on <b>toy</b>", timeout=LONG)
        expect(page.locator(".chart canvas")).to_be_visible(timeout=LONG)
        button(page, "about").first.click()
        expect(page.locator(".record")).to_contain_text("bc/toy/seed0", timeout=LONG)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
    status, text = get(address, "/document?name=report%20small")
    assert (status, text) == (200, "<title>the report</title>")


@pytest.mark.parametrize("library", ["", "glfw"])
def test_a_packed_robot_is_filmed_or_the_page_says_that_nothing_can_draw(
    library: str, tmp_path: Path
) -> None:
    still_hopper().save(tmp_path / "packed" / "hopper")
    words = (f"store={tmp_path}", f"policies={tmp_path / 'packed'}")
    with served(*words, MUJOCO_GL=library) as own, operating(own, "packed/hopper") as visit:
        picture = visit.page.locator(".scene .camera")
        if library:
            expect(visit.page.locator(".said")).to_contain_text("robot is not drawn", timeout=LONG)
            expect(picture).to_be_hidden()
        else:
            expect(picture).to_be_visible(timeout=LONG)
            wait_for(lambda: picture.evaluate("i => i.naturalWidth") == 320, "a whole picture")
            first = picture.get_attribute("src")
            wait_for(lambda: picture.get_attribute("src") != first, "the robot to move")
            visit.page.locator(".choice").click()
            visit.page.locator(".q-menu").get_by_text("world").click()
            expect(visit.page.locator(".scene canvas")).to_be_visible(timeout=LONG)
            expect(picture).to_be_hidden(timeout=LONG)
            before = steps(visit.page)
            wait_for(lambda: steps(visit.page) > before + 5, "the other system to run")
            expect(picture).to_be_hidden()
