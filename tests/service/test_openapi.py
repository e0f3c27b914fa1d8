"""The document of the API against the API: every operation is described, and nothing that is sent makes it fail."""

import itertools
from http import HTTPStatus

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import checks
from schemathesis.generation import GenerationMode
from serviced import listening, make_root
from test_service_results import Fits

from tract_dask.service.jobs.states import State

EXAMPLES = 3
"""Requests to an operation, well formed and not, beside those of its own examples."""

POSITIVE = GenerationMode.POSITIVE
BOUNDED = settings(
    max_examples=EXAMPLES,
    deadline=None,
    database=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)

CHECKED = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
)


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service with jobs in several states, one with results; its streams end at once."""
    with listening(make_root(tmp_path_factory.mktemp("service") / "data")) as (url, app):
        store = app.state.services.store
        jobs = [store.submit(source="movie.npy", settings={}, owner="local", label=f"job {k}") for k in range(4)]
        store.change(jobs[0].id, State.RUNNING)
        part = {"state": "running", "seconds": 1.0, "started": jobs[0].created, "ended": None, "summary": ""}
        part |= {"frames": 12, "done_frames": 4}
        store.progress(jobs[0].id, {"stage": "fit", "stages": {"fit": part}})
        store.log(jobs[0].id, "info", "it runs")
        store.change(jobs[1].id, State.RUNNING)
        store.change(jobs[1].id, State.FAILED, "the disk was full")
        fits = Fits(app.state.services.root.path / jobs[1].output)
        fits.create()
        fits.finish()
        app.state.services.streams.close()
        app.state.services.runner.is_alive = lambda: True  # what GET /health calls well
        yield url, [job.id for job in jobs], app


def operations(document: dict) -> list[tuple[str, str, dict]]:
    return [(path, method, found) for path, item in document["paths"].items() for method, found in item.items()]


def test_every_operation_is_described(service):
    _, _, app = service
    document = app.openapi()
    names = [found["operationId"] for _, _, found in operations(document)]
    assert len(set(names)) == len(names)
    for path, method, found in operations(document):
        where = f"{method} {path}"
        assert found["description"], where
        assert found["tags"], where
        for parameter in found.get("parameters", ()):
            known = parameter["name"] in ("job_id", "format") or "enum" in parameter["schema"]
            assert known or parameter.get("description"), f"{where}: {parameter['name']}"
        codes = set(found["responses"])
        assert {"401", "403", "422", "500"} <= codes, where
        assert ("404" in codes) >= ("{job_id}" in path), where
        for code in codes - {"200", "201", "304"}:
            schema = found["responses"][code]["content"]["application/json"]["schema"]
            assert schema["$ref"].endswith(("/ErrorBody", "/Health")), where
    schemas = document["components"]["schemas"]
    for name in ("NewJob", "JobRecord", "JobDetail", "JobList", "PlanAnswer", "About", "Listing", "Log"):
        assert schemas[name]["example"], name


def test_the_token_is_in_the_document_where_one_is_demanded(tmp_path, service):
    _, _, open_app = service
    assert "security" not in open_app.openapi()["paths"]["/api/v1/jobs"]["get"]
    with listening(make_root(tmp_path / "data"), tokens=True) as (_, app):
        document = app.openapi()
        assert all(found["security"] == [{"token": []}] for _, _, found in operations(document))


def test_a_path_says_all_the_methods_that_it_takes(service):
    url, jobs, app = service
    with httpx.Client(base_url=url) as client:
        for path, item in app.openapi()["paths"].items():
            answer = client.put(path.format(job_id=jobs[0], version=0, column_id=0))
            assert answer.status_code == HTTPStatus.METHOD_NOT_ALLOWED, path
            assert answer.headers["allow"].split(", ") == sorted(map(str.upper, item)), path


def test_nothing_that_is_sent_makes_it_fail(service):
    """Requests made from the document, with seeds that do not change: answers are as it says, and never a 5xx."""
    url, jobs, _ = service
    document = schemathesis.openapi.from_url(f"{url}/api/v1/openapi.json")
    chosen = [check for check in checks.CHECKS.get_all() if check.__name__ in CHECKED]
    assert len(chosen) == len(CHECKED)
    turn, asked = itertools.count(), set()

    def check(case: schemathesis.Case) -> None:
        if case.path_parameters and "job_id" in case.path_parameters and case.meta.generation.mode == POSITIVE:
            case.path_parameters["job_id"] = jobs[next(turn) % len(jobs)]
        answer = case.call()
        asked.add((case.method, case.path, answer.status_code))
        case.validate_response(answer, checks=chosen)

    for result in document.get_all_operations():
        operation = result.ok()
        for mode in (POSITIVE, GenerationMode.NEGATIVE):
            if mode == POSITIVE or operation.body or operation.query or operation.path_parameters:
                BOUNDED(given(operation.as_strategy(generation_mode=mode))(check))()
    codes = {code for _, _, code in asked}
    assert {HTTPStatus.OK, HTTPStatus.NOT_FOUND, HTTPStatus.UNPROCESSABLE_ENTITY} <= codes
    assert len({(method, path) for method, path, _ in asked}) == len(operations(document.raw_schema))
