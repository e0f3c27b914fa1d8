"""Modules that several pages share: how they become one script, and that none is taken for another."""

from pathlib import Path

import pytest

from tract_dask.service.pages import static_files
from tract_dask.web import bundle


@pytest.fixture
def modules(tmp_path):
    """Write modules, and return the path of the first."""

    def write(**sources):
        for name, source in sources.items():
            (tmp_path / f"{name}.js").write_text(source)
        return tmp_path / f"{next(iter(sources))}.js"

    return write


def test_every_module_keeps_its_own_names(chromium, modules):
    page = modules(
        page='import { first } from "./one.js";\nimport { second, More } from "./two.js";\n'
        "const secret = 3;\nglobalThis.found = [first(), second, new More().value, secret];\n",
        one="const secret = 1;\nexport function first() { return secret; }\n",
        two='import { first } from "./one.js";\nconst secret = 2;\nexport const second = secret + first();\n'
        "export class More { value = 10 * secret; }\n",
    )
    script = bundle(page)
    assert script.count("function first()") == 1
    shown = chromium.new_page()
    shown.set_content(f'<script type="module">{script}</script>')
    assert shown.evaluate("globalThis.found") == [1, 3, 20, 3]


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ('import * as all from "./one.js";\n', "import"),
        ('import { a as b } from "./one.js";\n', "import"),
        ('import "./one.js";\n', "import"),
        ('const one = await import("./one.js");\n', "import"),
        ("const here = import.meta.url;\n", "import.meta"),
        ("export default 1;\n", "export default"),
        ("export { a };\n", "export"),
        ("export let a = 1;\n", "export let"),
        ('const end = "</script>";\n', "</script"),
        ("const begin = '<!--';\n", "<!--"),
        ('import { a } from "./page.js";\n', "page.js -> page.js"),
        ('import { dom } from "./dom.js";\n', "two modules have the name dom.js"),
    ],
)
def test_what_cannot_stand_in_a_script_is_refused(modules, source, reason):
    page = modules(page=source, one="export const a = 1;\n", dom="export const dom = 1;\n")
    with pytest.raises(ValueError, match=r"one another|cannot stand|two modules") as refused:
        bundle(page)
    assert reason in str(refused.value)


def test_a_missing_module_is_named(modules):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.js"):
        bundle(modules(page='import { a } from "./nowhere.js";\n'))


def test_shared_and_own_files_have_different_names():
    own, shared = ({file.name for file in Path(place).iterdir()} for place in static_files.all_directories)
    assert not own & shared
    assert {"charts.js", "theme.css"} <= shared
    for name in ("charts.js", "results.js"):
        assert static_files.lookup_path(name)[1] is not None
    assert static_files.lookup_path("bundle.py")[1] is None
    assert static_files.lookup_path("../bundle.py")[1] is None
