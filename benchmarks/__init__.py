"""How fast and how exact the fits are, beside other programs and beside bare loops; run by ``scripts/bench``.

Every section (kernel, stages, runs, scheduler, startup) measures one subject and returns JSON-ready figures; ``report``
turns all of them into the table of docs/performance.md, ``plots`` into its figure.
"""
