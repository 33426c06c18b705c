"""Drives the page in a headless Chromium: by key for 20 s, backwards, by link, by touch, with what
goes wrong.

    python drive_in_a_browser.py [--pictures FOLDER] [--bench FILE]

Serves docs/live on a port of its own. Wants the package playwright and a Chromium: that of the
system, or the one that CHROMIUM names.
"""

import argparse
import functools
import http.server
import json
import math
import os
import pathlib
import shutil
import sys
import threading
import time

from playwright.sync_api import sync_playwright

ROOT = pathlib.Path(__file__).resolve().parents[3]
LIVE = ROOT / "docs" / "live"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def serve():
    handler = functools.partial(Quiet, directory=str(LIVE))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_address[1]}/"


def chromium():
    for name in [os.environ.get("CHROMIUM"), "chromium", "chromium-browser", "google-chrome"]:
        found = name and shutil.which(name)
        if found:
            return found
    return None


class Visit:
    """A visit to the page, which notes every error that the page meets."""

    def __init__(self, browser, address, **context):
        self.context = browser.new_context(**context)
        self.page = self.context.new_page()
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda said: said.type == "error" and self.errors.append(said.text))
        self.address = address

    def open(self, rest=""):
        self.page.goto(self.address + rest)
        return self

    def ready(self):
        self.page.wait_for_function("document.body.dataset.mode === 'ready'", timeout=60_000)
        return self

    def trouble(self):
        self.page.wait_for_selector("#trouble:not([hidden])", timeout=60_000)
        return self.page.inner_text("#trouble-text")

    def state(self, what):
        return self.page.evaluate(f"gump.state.{what}")

    def ego(self):
        return self.page.evaluate(
            "(() => { const n = gump.state.now; const i = 5 + 8 * n[2]; return [n[i], n[i + 1], n[i + 2]]; })()"
        )

    def close(self):
        self.context.close()


def steer_for_twenty_seconds(browser, address, picture):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800})
    visit.open().ready()
    picture(visit, "desktop-start")
    first = visit.ego()
    others = visit.page.evaluate("[...gump.state.now]")
    visit.page.keyboard.press("Enter")
    began = time.monotonic()
    visit.page.keyboard.down("ArrowUp")
    shot = False
    while time.monotonic() - began < 20:
        key = ["ArrowLeft", "ArrowRight"][int(time.monotonic() - began) % 2]
        visit.page.keyboard.down(key)
        visit.page.wait_for_timeout(120)
        visit.page.keyboard.up(key)
        visit.page.wait_for_timeout(380)
        if time.monotonic() - began > 3:
            visit.page.keyboard.up("ArrowUp")
        if not shot and time.monotonic() - began > 4:
            picture(visit, "desktop-driving")
            shot = True
    driven = visit.state("driven")
    assert driven >= 150, f"expected about 200 frames in 20 s, found {driven}"
    last = visit.ego()
    metres = ((last[0] - first[0]) ** 2 + (last[1] - first[1]) ** 2) ** 0.5
    assert metres > 10, f"the ego came {metres:.1f} m far"
    now = visit.page.evaluate("[...gump.state.now]")
    assert len(now) == len(others) and now != others
    moved = sum(
        abs(now[5 + 8 * k] - others[5 + 8 * k]) + abs(now[6 + 8 * k] - others[6 + 8 * k]) > 1
        for k in range(int(now[3]))
    )
    assert moved > 5, f"{moved} agents moved"
    assert visit.page.inner_text("#speed").isdigit()
    # Back to 5 s, and on from there.
    visit.page.evaluate("(() => { const t = document.getElementById('time'); t.value = '50'; t.dispatchEvent(new Event('input')); })()")
    visit.page.wait_for_function("gump.state.shown === 50 && gump.state.mode === 'paused'")
    visit.page.click("#pause")
    visit.page.wait_for_function("gump.state.driven > 55 && gump.state.driven < 120")
    # Eight futures.
    visit.page.click("#branch")
    visit.page.wait_for_selector("#futures-rows tr:nth-child(8)", timeout=60_000)
    visit.page.click("#futures-rows tr:nth-child(3)")
    visit.page.wait_for_timeout(1500)
    picture(visit, "desktop-futures")
    # The end.
    visit.page.keyboard.press("Escape")
    visit.page.click("#end")
    visit.page.wait_for_selector("#score:not([hidden])", timeout=60_000)
    total = float(visit.page.inner_text("#total"))
    assert 0 <= total <= 1
    assert visit.page.locator("#parts tr").count() == 8
    picture(visit, "desktop-end")
    visit.page.click("#share")
    visit.page.wait_for_function("location.hash.includes('drive=')")
    answer = visit.page.evaluate("gump.engine.ask('code')")
    link = visit.page.evaluate("location.hash")
    assert visit.errors == [], visit.errors
    visit.close()
    return link, answer


def reverse_gear(browser, address, picture):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800}).open().ready()
    keys = visit.page.keyboard
    visit.page.click("#go")
    # Held, the brake stops the car and keeps it there.
    keys.down("ArrowDown")
    visit.page.wait_for_function("gump.state.driven > 20 && gump.state.now[1] === 0")
    visit.page.wait_for_timeout(800)
    assert visit.state("now[1]") == 0 and visit.page.inner_text("#gear") == "D"
    keys.up("ArrowDown")
    visit.page.wait_for_timeout(300)
    stood = visit.ego()
    # Pressed anew it drives backwards, not too fast.
    keys.down("s")
    visit.page.wait_for_function("gump.state.now[1] < -4.9")
    assert visit.page.inner_text("#gear") == "R" and visit.page.inner_text("#speed") == "18"
    picture(visit, "desktop-reverse")
    keys.up("s")
    x, y, heading = stood
    now = visit.ego()
    ahead = (now[0] - x) * math.cos(heading) + (now[1] - y) * math.sin(heading)
    assert ahead < -3, f"the ego went {ahead:.1f} m ahead"
    # Gas stops it, then drives on.
    keys.down("w")
    visit.page.wait_for_function("gump.state.now[1] > 2")
    assert visit.page.inner_text("#gear") == "D"
    keys.up("w")
    visit.page.click("#pause")
    visit.page.wait_for_function("!gump.state.busy")
    answer = visit.page.evaluate("gump.engine.ask('code')")
    assert visit.errors == [], visit.errors
    visit.close()
    a_link_replays_the_drive(browser, address, f"#scene=crossing&seed=1&density=1&drive={answer['code']}", answer)


def a_link_replays_the_drive(browser, address, link, answer):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800}, color_scheme="dark")
    visit.open(link).ready()
    assert visit.page.inner_text("#go") == "Watch this drive"
    visit.page.click("#go")
    visit.page.wait_for_function("document.body.dataset.mode === 'paused'", timeout=120_000)
    again = visit.page.evaluate("gump.engine.ask('code')")
    assert again == answer, "the link drove another drive"
    assert visit.errors == [], visit.errors
    visit.close()


def drivers_by_rule_drive(browser, address):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800}).open().ready()
    visit.page.click("#go")
    for driver in ["1", "2", "3"]:
        visit.page.select_option("#driver", driver)
        before = visit.state("driven")
        visit.page.wait_for_function(f"gump.state.driven > {before + 12}", timeout=60_000)
        assert visit.page.input_value("#driver") == driver
    assert visit.page.is_hidden("#trouble")
    assert visit.errors == [], visit.errors
    visit.close()


def every_scene_opens(browser, address):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800}).open().ready()
    for value in visit.page.eval_on_selector_all("#scene option", "all => all.map(o => o.value)"):
        if value != visit.state("scene.id"):
            visit.page.select_option("#scene", value)
        visit.page.wait_for_function(f"gump.state.scene.id === '{value}' && gump.state.mode === 'ready'", timeout=60_000)
        visit.page.click("#go")
        visit.page.wait_for_function("gump.state.driven > 6", timeout=60_000)
    assert visit.errors == [], visit.errors
    visit.close()


def nothing_is_cut(visit):
    """Wheel and pedals are whole, large enough for thumbs, and on nothing else that is pressed."""
    size = visit.page.viewport_size
    box = lambda name: visit.page.locator(name).bounding_box()
    over = lambda a, b: a["x"] < b["x"] + b["width"] and b["x"] < a["x"] + a["width"] and a["y"] < b["y"] + b["height"] and b["y"] < a["y"] + a["height"]
    hands = {name: box(name) for name in ["#touch-wheel", "#touch-brake", "#touch-gas"]}
    for name, one in hands.items():
        assert min(one["width"], one["height"]) >= 72, f"{name} is {one}"
        assert one["x"] >= 0 and one["x"] + one["width"] <= size["width"], f"{name} is {one}"
        for other in ["#dash", "#pause", "#end", "#time", *hands]:
            assert other == name or not over(one, box(other)), f"{name} lies on {other}"


def on_a_phone(browser, address, picture):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True, "device_scale_factor": 2}
    visit = Visit(browser, address, **phone, color_scheme="dark").open().ready()
    picture(visit, "phone-start")
    visit.page.tap("#go")
    fingers = visit.context.new_cdp_session(visit.page)

    def touch(kind, *places):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def middle(name):
        box = visit.page.locator(name).bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    gas, wheel = middle("#touch-gas"), middle("#touch-wheel")
    touch("touchStart", gas)
    visit.page.wait_for_timeout(2500)
    touch("touchStart", gas, wheel)
    touch("touchMove", gas, (wheel[0] - 25, wheel[1]))
    visit.page.wait_for_timeout(1500)
    pedal, turn = visit.state("input[1]"), visit.state("input[2]")
    assert pedal > 50 and turn > 10, f"the pedal is at {pedal}, the wheel at {turn}"
    picture(visit, "phone-driving")
    touch("touchEnd")
    # The pedals say what they do next: the brake of a car that stands drives backwards.
    brake = middle("#touch-brake")
    assert visit.page.inner_text("#touch-brake") == "Brake"
    touch("touchStart", brake)
    visit.page.wait_for_function("gump.state.now[1] === 0", timeout=60_000)
    touch("touchEnd")
    visit.page.wait_for_timeout(300)
    assert visit.page.inner_text("#touch-brake") == "Reverse"
    touch("touchStart", brake)
    visit.page.wait_for_function("gump.state.now[1] < -2", timeout=60_000)
    assert visit.page.inner_text("#touch-gas") == "Brake"
    picture(visit, "phone-reverse")
    touch("touchEnd")
    nothing_is_cut(visit)
    assert visit.errors == [], visit.errors
    assert visit.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than the phone"
    visit.page.tap("#end")
    visit.page.wait_for_selector("#score:not([hidden])", timeout=60_000)
    picture(visit, "phone-end")
    visit.close()
    visit = Visit(browser, address, **phone, color_scheme="light").open().ready()
    picture(visit, "phone-start-light")
    visit.page.tap("#go")
    # On its side.
    visit.page.set_viewport_size({"width": 844, "height": 390})
    visit.page.wait_for_timeout(500)
    nothing_is_cut(visit)
    picture(visit, "phone-on-its-side")
    visit.close()


def what_goes_wrong_is_told(browser, address, picture):
    def check(expected, prepare, rest="", act=None):
        visit = Visit(browser, address, viewport={"width": 900, "height": 700}, color_scheme="dark")
        prepare(visit)
        visit.open(rest)
        if act:
            visit.ready()
            act(visit)
        message = visit.trouble()
        assert expected in message, f"expected {expected!r}, found {message!r}"
        if "SIMD" in expected:
            picture(visit, "error")
        visit.close()

    def drop(name, content):
        def act(visit):
            file = {"name": name, "mimeType": "application/octet-stream", "buffer": content}
            visit.page.set_input_files("#file", files=[file])
        return act

    def nothing(_visit):
        pass

    def damaged(visit):
        def answer(route):
            body = bytearray((LIVE / "gump-relative.safetensors").read_bytes())
            body[-1] ^= 1
            route.fulfill(body=bytes(body))
        visit.context.route("**/*.safetensors", answer)

    def missing(pattern):
        return lambda visit: visit.context.route(pattern, lambda route: route.fulfill(status=404, body=""))

    def without_vectors(visit):
        def answer(route):
            body = "WebAssembly.validate = () => false;\n" + (LIVE / "worker.js").read_text()
            route.fulfill(body=body, content_type="text/javascript")
        visit.context.route("**/worker.js", answer)

    check("128-bit SIMD", without_vectors)
    check("checksum", damaged)
    check("answers 404", missing("**/*.safetensors"))
    check("list of scenes", missing("**/manifest.json"))
    check("answers 404", missing("**/scenes/*"))
    check("The engine could not be loaded", missing("**/worker.js"))
    check("cannot be read as a scene", nothing, act=drop("hello.json", b"hello"))
    check("cannot be read as a scene", nothing, act=drop("empty.json", b""))
    # GPUDrive's layout, with more agents than the page drives among.
    agent = {"position": [{"x": 0, "y": 0}] * 12, "heading": [0] * 12, "velocity": [{"x": 0, "y": 0}] * 12,
             "valid": [True] * 12, "length": 4, "width": 2, "type": "vehicle"}
    agents = [{**agent, "id": i, "position": [{"x": 9 * i, "y": 0}] * 12} for i in range(300)]
    road = {"type": "lane", "geometry": [{"x": 0, "y": 0}, {"x": 3000, "y": 0}]}
    crowd = json.dumps({"name": "crowd", "objects": agents, "roads": [road], "tl_states": {}})
    check("too large", nothing, act=drop("crowd.json", crowd.encode()))
    check("holds no drive", nothing, "#scene=crossing&drive=AAAA")
    check("does not have", nothing, "#scene=nowhere")


def bench(browser, address, file):
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800})
    visit.open("?bench")
    visit.page.wait_for_function("document.querySelector('#bench')?.textContent.endsWith('Done.')", timeout=600_000)
    results = json.loads(visit.page.get_attribute("#bench", "data-results"))
    visit.close()
    visit = Visit(browser, address, viewport={"width": 1280, "height": 800}).open().ready()
    visit.page.wait_for_function("performance.getEntriesByName('first-picture').length > 0")
    first = visit.page.evaluate("performance.getEntriesByName('first-picture')[0].startTime")
    visit.close()
    text = json.dumps({"first_picture_ms": round(first), "scenes": results}, indent=2)
    pathlib.Path(file).write_text(text + "\n")
    print(text)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=pathlib.Path)
    parser.add_argument("--bench")
    arguments = parser.parse_args()
    executable = chromium()
    if executable is None:
        print("SKIPPED: expected a Chromium, found none", file=sys.stderr)
        return
    address = serve()

    def picture(visit, name):
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            visit.page.screenshot(path=str(arguments.pictures / f"{name}.png"))

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        if arguments.bench:
            bench(browser, address, arguments.bench)
        else:
            link, answer = steer_for_twenty_seconds(browser, address, picture)
            a_link_replays_the_drive(browser, address, link, answer)
            reverse_gear(browser, address, picture)
            drivers_by_rule_drive(browser, address)
            every_scene_opens(browser, address)
            on_a_phone(browser, address, picture)
            what_goes_wrong_is_told(browser, address, picture)
            print("driven in", browser.browser_type.name, browser.version)
        browser.close()


if __name__ == "__main__":
    main()
