"""The pages in a browser: jobs submitted, watched, cancelled and tried again, by somebody who clicks and types."""

import re
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import Scene
from playwright import sync_api as playwright
from serviced import listening, make_root

from tract_dask.progress import REPORT, STAGES
from tract_dask.service.jobs.states import State
from tract_dask.settings import ClusterSettings

THEMES = ("light", "dark")
PATIENCE_MS = 15_000
RUN_MS = 120_000
LEAST_CONTRAST = 4.5

expect = playwright.expect
expect.set_options(timeout=PATIENCE_MS)

# what is written on what: WCAG's 4.5 holds for each pair, in both themes
PAIRS = [
    *((ink, ground) for ink in ("text", "muted", "accent") for ground in ("bg", "panel", "hover", "raised")),
    *((kind, f"{kind}-soft") for kind in ("good", "warn", "bad", "accent")),
    *((kind, "panel") for kind in ("good", "warn", "bad")),
    *(("text", f"{kind}-soft") for kind in ("good", "warn", "bad", "accent")),
    ("muted", "sunken"),
    ("on-accent", "accent-fill"),
    ("on-accent", "accent-fill-hover"),
]


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service whose jobs do what the test says: its address and its store."""
    with listening(make_root(tmp_path_factory.mktemp("root"))) as (address, app):
        yield address, app.state.services.store


@pytest.fixture
def store(service):
    """Return the store, without jobs."""
    store = service[1]
    for job in store.jobs(limit=1000):
        if job.state == State.RUNNING:
            store.change(job.id, State.FAILED)
        store.delete(job.id)
    return store


@contextmanager
def visit(chromium, address, theme="light", refused=()):
    """A page that has to end without a complaint of the browser: no error, nothing against the content policy.

    ``refused``: answers of the service that a test provokes, of which the browser tells, too.
    """
    context = chromium.new_context(base_url=address, color_scheme=theme, viewport={"width": 1366, "height": 768})
    context.set_default_timeout(PATIENCE_MS)
    page, said = context.new_page(), []
    page.on("console", lambda message: message.type in ("error", "warning") and said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    try:
        yield page
        assert not [text for text in said if not any(part in text for part in refused)]
    finally:
        context.close()


@pytest.fixture
def page(chromium, service):
    with visit(chromium, service[0]) as page:
        yield page


def queue(store, **more):
    return store.submit(**{"source": "movie.npy", "settings": {}, "owner": "local"} | more)


def run(store, **more):
    job = queue(store, **more)
    return store.change(job.id, State.RUNNING, "its turn")


def progress(stage: str, done: int, frames: int = 40, **more) -> dict:
    """What a job's process says when ``done`` of ``frames`` have gone through ``stage``."""
    empty = {"state": "pending", "seconds": None, "started": None, "ended": None, "frames": 0, "done_frames": 0}
    stages = {name: empty | {"summary": ""} for name in (*STAGES, REPORT)}
    for name in (*STAGES, REPORT)[: STAGES.index(stage)]:
        stages[name] |= {"state": "done", "seconds": 2.0, "frames": frames, "done_frames": frames}
    stages[stage] |= {"state": "running", "seconds": 1.0, "frames": frames, "done_frames": done}
    told = {"stage": stage, "done_frames": done, "frames": frames, "passes": 1, "fits": 30 * done, "stages": stages}
    return told | {"frames_per_s": 20.0, "fits_per_s": 600.0, "seconds_left": 42.0, "fraction": done / frames} | more


def row_of(page, job):
    return page.locator(f"tr[data-job='{job.id}']")


def field(page, label):
    return page.get_by_label(label, exact=True)


def test_a_folder_of_frames_is_opened_as_one_movie_by_a_click(chromium, tmp_path):
    frames = Scene(n_frames=5).counts()
    (tmp_path / "frames").mkdir()
    for number, frame in enumerate(frames):
        np.save(tmp_path / "frames" / f"f_{number}.npy", frame)
    np.save(tmp_path / "alone.npy", frames)
    with listening(tmp_path) as (address, _), visit(chromium, address) as page:
        page.goto("/new")
        expect(page.get_by_role("button", name="alone.npy")).to_be_visible()
        expect(page.locator("#as-one")).to_be_hidden()
        page.locator("[data-path=frames]").click()
        page.locator("#as-one").click()
        expect(page.locator("#source-facts")).to_contain_text("5 frames · 144 × 160 px")
        expect(page.locator("#source-facts")).to_contain_text("5 files")
        page.locator("#group-source summary").click()
        field(page, "Frames").fill("0:3")
        page.locator("#other").click()
        page.get_by_role("button", name="Data root").click()
        page.get_by_role("button", name="alone.npy").click()
        expect(page.locator("#source-name")).to_have_text("alone.npy")
        expect(field(page, "Frames")).to_have_value("")


def test_a_movie_is_chosen_looked_at_and_measured_from_the_page(chromium, tmp_path):
    scene = Scene(n_frames=12)
    (tmp_path / "2026-11").mkdir()
    np.save(tmp_path / "2026-11" / "grid.npy", scene.counts())
    with (
        listening(tmp_path, cluster=ClusterSettings(workers=1)) as (address, app),
        visit(chromium, address) as page,
    ):
        app.state.services.runner.start()
        try:
            page.goto("/")
            page.locator("#nothing").get_by_role("link", name="New job").click()
            page.get_by_role("button", name="2026-11").click()
            page.get_by_role("button", name="grid.npy").click()
            expect(page.locator("#source-facts")).to_contain_text("12 frames · 144 × 160 px")
            expect(page.locator("#metadata-note")).to_contain_text("no pixel size")
            field(page, "Pixel size").fill("8")
            field(page, "Label").fill("a grid")
            page.locator("#group-convert summary").click()
            field(page, "Shard").fill("1")
            page.get_by_role("button", name="Submit").click()
            page.wait_for_url(re.compile("/jobs/[0-9a-f]{10}$"), timeout=RUN_MS)
            job = page.url.rsplit("/", 1)[1]
            expect(page.locator(".stage[data-stage=convert]")).to_have_attribute("data-state", "done", timeout=RUN_MS)
            expect(page.locator("#badge")).to_have_text("Done", timeout=RUN_MS)
        finally:
            app.state.services.runner.stop()
        done = app.state.services.store.job(job)
        assert done.settings["metadata"]["pixel_size_pm"] == 8.0
        assert done.settings["convert"]["shard_mb"] == 1.0
        assert done.outcome["columns"] == len(scene.place)
        expect(page.locator("#figures dd").nth(1)).to_have_text(str(len(scene.place)))
        expect(page.locator("#picture-title")).to_have_text("Sum of the frames")
        drift = page.locator("#drift canvas")
        curves = re.compile("Drift: x from .* to .*; y from")
        expect(drift).to_have_attribute("aria-label", curves, timeout=RUN_MS)  # the first answer's process imports
        largest = np.abs(scene.drift * 8.0).max()
        assert max(map(abs, _numbers(drift.get_attribute("aria-label")))) == pytest.approx(largest, abs=0.5 * 8.0)
        accepted = _numbers(page.locator("#accepted canvas").get_attribute("aria-label"))
        assert min(accepted) > 90
        assert max(accepted) <= 100
        expect(page.locator("#colour-by")).to_be_enabled()
        box, (height, width), (x, y) = page.locator("#picture").bounding_box(), scene.shape, scene.place[3]
        scale = min((box["width"] - 8) / width, (box["height"] - 8) / height)
        page.mouse.move(
            box["x"] + box["width"] / 2 + scale * (x - (width - 1) / 2),
            box["y"] + box["height"] / 2 + scale * (y - (height - 1) / 2),
        )
        column = re.match(r"Column (\d+)", page.locator("#pointed").text_content())[1]
        page.mouse.down()
        page.mouse.up()
        page.wait_for_url(f"**/jobs/{job}/results#columns={column}")
        expect(page.locator("#chosen li")).to_have_text(f"{column}×")


def _numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", text)]


def test_the_list_follows_a_job_without_reload(page, store):
    page.goto("/")
    expect(page.locator("#nothing")).to_contain_text("No jobs yet")
    job = queue(store, label="CeO2")
    row = row_of(page, job)
    expect(row.locator(".badge")).to_have_text("Queued")
    row.evaluate("row => { row.seen = true; }")
    store.change(job.id, State.RUNNING, "its turn")
    store.progress(job.id, progress("fit", 10))
    expect(row).to_contain_text("Fit · 10 of 40 frames")
    expect(row).to_contain_text("20.0 frames/s")
    expect(row).to_contain_text("600 fits/s")
    expect(row.get_by_role("progressbar")).to_have_attribute("aria-valuenow", "25")
    store.progress(job.id, progress("fit", 30))
    expect(row.get_by_role("progressbar")).to_have_attribute("aria-valuenow", "75")
    outcome = {"frames": 40, "columns": 30, "fits": 1200, "accepted": 1180, "bad_frames": 0}
    store.change(job.id, State.DONE, outcome=outcome)
    expect(row.locator(".badge")).to_have_text("Done")
    expect(row).to_contain_text("98.3")
    assert row.evaluate("row => row.seen"), "the row was made anew"
    assert not page.evaluate("performance.getEntriesByType('navigation').length > 1")


def test_jobs_are_filtered_by_state_owner_and_text_and_older_ones_follow(page, store):
    for number in range(60):
        queue(store, label=f"grid {number}", owner="ana" if number % 2 else "ben")
    failed = run(store, label="broken", owner="ana")
    store.change(failed.id, State.FAILED, "the movie has no frames")
    rows = page.locator("tr[data-job]")
    page.goto("/")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Show older jobs").click()
    expect(rows).to_have_count(61)
    expect(page.get_by_role("button", name="Show older jobs")).to_be_hidden()
    page.get_by_role("button", name="Failed").click()
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("the movie has no frames")
    page.get_by_role("button", name="All").click()
    field(page, "Owner").select_option("ana")
    expect(rows).to_have_count(31)
    page.get_by_role("searchbox").fill("grid 5")
    expect(rows).to_have_count(6)  # 5, 51, 53, 55, 57, 59
    page.reload()
    expect(rows).to_have_count(6)
    page.get_by_role("searchbox").fill("nothing like it")
    expect(page.locator("#nothing")).to_contain_text("No job is like that")


def test_a_job_is_cancelled_tried_again_and_deleted(page, store):
    job = run(store, label="CeO2")
    page.goto("/")
    row = row_of(page, job)
    row.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Keep as it is").click()
    assert not store.cancel_requested(job.id)
    row.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the job").click()
    expect(row.locator(".badge")).to_have_text("Cancelling")
    assert store.cancel_requested(job.id)
    store.change(job.id, State.CANCELLED, store.cancel_reason(job.id))
    row.get_by_role("button", name="Retry").click()
    expect(row.locator(".badge")).to_have_text("Queued")
    store.request_cancel(job.id, "enough")
    row.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete", exact=True).last.click()
    expect(row).to_have_count(0)
    assert not store.jobs()


def test_a_job_is_watched_live(page, store):
    job = run(store, label="CeO2")
    page.goto(f"/jobs/{job.id}")
    expect(page.locator("#stage")).to_have_text("Starting: the cluster gets ready")
    store.stage(job.id, "drift")
    for done in (4, 12, 20):
        store.progress(job.id, progress("drift", done))
        expect(page.locator("#stage")).to_have_text(f"Drift · {done} of 40 frames")
    expect(page.locator("#bar")).to_have_attribute("aria-valuenow", "50")
    expect(page.locator(".stage[data-stage=convert]")).to_have_attribute("data-state", "done")
    expect(page.locator(".stage[data-stage=drift]")).to_have_attribute("data-state", "running")
    expect(page.locator("#speed canvas")).to_have_attribute("aria-label", "Throughput: frames/s from 20.0 to 20.0")
    worker = {"name": "w1", "address": "tcp://127.0.0.1:1", "cpu": 97.0, "executing": 1, "stage": "drift"}
    store.workers(job.id, {"workers": [worker | {"memory": 3e9, "memory_limit": 4e9}], "dashboard": True})
    expect(page.locator("#workers tbody tr")).to_contain_text("Drift")
    expect(page.locator("#workers tbody tr")).to_contain_text("3 GB of 4 GB")
    expect(page.get_by_role("meter", name="Memory of worker w1")).to_have_attribute("aria-valuenow", "75")
    expect(page.locator("#dashboard")).to_be_visible()
    store.log(job.id, "warning", "frame 7 is dark")
    expect(page.locator("#log li").first).to_contain_text("frame 7 is dark")
    expect(page).to_have_title(re.compile("^50.%"))
    store.change(job.id, State.WAITING, "the columns can be looked at")
    expect(page.get_by_role("link", name="Check the columns")).to_have_attribute("href", f"/jobs/{job.id}/columns")


def test_a_failed_job_says_what_where_and_what_to_do(page, store):
    job = run(store)
    reason = "movie.npy: the movie ends in a frame. Expected 12 frames; got 11.5 frames. Copy it again."
    store.change(job.id, State.FAILED, reason, progress=progress("convert", 10))
    page.goto(f"/jobs/{job.id}")
    parts = page.get_by_role("alert").locator("p")
    expect(parts).to_have_text(
        ["movie.npy: the movie ends in a frame", "Expected 12 frames; got 11.5 frames", "Copy it again"]
    )
    expect(page.locator(".stage[data-stage=convert]")).to_have_attribute("data-state", "failed")
    page.get_by_role("button", name="Retry").click()
    expect(page.locator("#badge")).to_have_text("Queued")
    assert store.job(job.id).state == State.QUEUED


def test_what_was_missed_comes_when_the_connection_is_back(chromium, service, store):
    job = run(store, label="CeO2")
    with visit(chromium, service[0], refused=["ERR_INTERNET_DISCONNECTED"]) as page:
        page.goto("/")
        expect(row_of(page, job).locator(".badge")).to_have_text("Running")
        page.context.set_offline(True)
        service[1].log(job.id, "info", "said meanwhile")
        service[1].progress(job.id, progress("fit", 20))
        page.evaluate(
            "import('/static/api.js').then(api => api.get('/jobs')).catch(error => { window.said = error.what; })"
        )
        page.wait_for_function("window.said === 'The service does not answer'")
        page.context.set_offline(False)
        expect(row_of(page, job)).to_contain_text("20 of 40 frames")
        expect(page.locator("#banner")).to_be_hidden()


def test_a_wrong_setting_is_told_beside_its_field(chromium, service):
    with visit(chromium, service[0], refused=["status of 400"]) as page:
        page.goto("/new?source=movie.npy")
        submit = page.get_by_role("button", name="Submit")
        expect(submit).to_be_enabled()
        window = page.locator("[data-setting='fit.window_px']")
        window.get_by_role("textbox").fill("3")
        expect(window.locator(".problem")).to_have_text("At least 5 px")
        expect(submit).to_be_disabled()
        window.get_by_role("button", name="Reset").click()
        expect(submit).to_be_enabled()
        field(page, "Estimator").select_option("poisson")
        page.locator("#group-fit summary").click()
        field(page, "Filter").select_option("wiener")
        expect(page.locator("[data-setting='fit.filter'] .problem")).to_contain_text("filtered frames are not counts")
        expect(submit).to_be_disabled()
        page.get_by_role("button", name="Reset all").click()
        expect(submit).to_be_enabled()


def test_a_raw_file_asks_for_its_shape_and_then_opens(chromium, service):
    with visit(chromium, service[0], refused=["status of 400"]) as page:
        page.goto("/new?source=movie.raw")
        expect(page.locator("#source-problem")).to_contain_text("raw")
        field(page, "Raw shape").fill("12, 48, 40")
        field(page, "Raw dtype").fill("uint8")
        expect(page.locator("#source-facts")).to_contain_text("12 frames · 40 × 48 px")


def test_a_job_like_another_begins_with_its_settings(page, store):
    job = queue(store, label="CeO2", curate=True, settings={"fit": {"window_px": 21}, "drift": {"method": "none"}})
    page.goto(f"/new?from={job.id}")
    expect(field(page, "Fit window")).to_have_value("21")
    expect(field(page, "Drift")).to_have_value("none")
    expect(field(page, "Label")).to_have_value("CeO2")
    expect(page.get_by_role("checkbox", name="Stop for me to check the columns")).to_be_checked()


def test_an_unknown_job_has_a_page_that_leads_on(chromium, service):
    with visit(chromium, service[0], refused=["status of 404"]) as page:
        assert page.goto("/jobs/0123456789").status == 404
        expect(page.locator("h2")).to_have_text("There is no such job")
        page.get_by_role("link", name="To the list of jobs").click()
        expect(page.locator("h1")).to_have_text("Jobs")


NUMBERS = [
    ("duration(0.4)", "0.4 s"),
    ("duration(38.2)", "38 s"),
    ("duration(250)", "4 min 10 s"),
    ("duration(3600)", "1 h"),
    ("duration(86400 * 3 + 7200 * 2)", "3 d 4 h"),
    ("left(212)", "3 min 45 s"),
    ("rate(1234567)", "1.23M"),
    ("rate(36149)", "36.1k"),
    ("rate(1327)", "1,327"),
    ("rate(3.25)", "3.25"),
    ("rate(0)", "0"),
    ("bytes(999)", "999 B"),
    ("bytes(1270000000)", "1.27 GB"),
    ("percent(0.99999)", "99.9\u202f%"),
    ("percent(0.00001)", "0.1\u202f%"),
    ("percent(1)", "100\u202f%"),
    ("count(12288)", "12,288"),
    ("significant(0.012345)", "0.0123"),
    ("significant(123456)", "123,456"),
    ("several(1, 'frame')", "1 frame"),
    ("several(2, 'entry', 'entries')", "2 entries"),
    ("ticks(0, 97, 5).values.map(value => tickText(value, 20)).join()", "0,20,40,60,80"),
    ("ticks(-0.31, 0.52, 4).values.map(value => tickText(value, 0.2)).join()", "-0.2,0,0.2,0.4"),
    ("tickText(1200000, 200000)", "1.2M"),
    ("nearest([0, 1, 3, 7], 4.9)", 2),
    ("nearest([0, 1, 3, 7], 5.1)", 3),
]


def test_numbers_are_written_as_people_read_them(page):
    page.goto("/")
    page.evaluate(
        """async () => {
            const modules = ["format", "chart_scale"].map(name => import(`/static/${name}.js`));
            Object.assign(window, ...await Promise.all(modules));
        }"""
    )
    assert [(call, page.evaluate(call)) for call, _ in NUMBERS] == NUMBERS


def test_the_theme_follows_the_system_until_it_is_chosen(chromium, service):
    with visit(chromium, service[0], "dark") as page:
        page.goto("/")
        root = page.locator("html")
        expect(root).to_have_attribute("data-theme", "dark")
        page.get_by_role("button", name="Light or dark").click()
        expect(root).to_have_attribute("data-theme", "light")
        page.goto("/new")
        expect(root).to_have_attribute("data-theme", "light")


def test_no_page_complains_or_is_too_wide(page, store):
    done, failed = run(store), run(store)
    store.change(done.id, State.DONE, outcome={"frames": 12, "columns": 3, "fits": 36, "accepted": 30})
    store.change(failed.id, State.FAILED, "it broke")
    for path in ("/", "/new", "/new?source=movie.npy", f"/jobs/{done.id}", f"/jobs/{failed.id}"):
        page.goto(path)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), path


@pytest.mark.parametrize("theme", THEMES)
def test_text_can_be_read(chromium, service, theme):
    with visit(chromium, service[0], theme) as page:
        page.goto("/")
        low = {pair: ratio for pair in PAIRS if (ratio := _contrast(page, *pair)) < LEAST_CONTRAST}
    assert not low


def _contrast(page, ink: str, ground: str) -> float:
    """The contrast ratio of two variables of the style sheet; WCAG 2.2, relative luminance."""
    found = page.evaluate(
        "names => names.map(name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim())",
        [ink, ground],
    )
    channels = np.array([[int(code[at : at + 2], 16) / 255 for at in (1, 3, 5)] for code in found])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    darker, lighter = sorted(linear @ np.array([0.2126, 0.7152, 0.0722]))
    return float((lighter + 0.05) / (darker + 0.05))
