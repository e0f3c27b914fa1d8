"""The service: jobs in a store on disk, a runner that drives the pipeline, a REST API, and web pages over that API.

``config`` what the service was started with; ``folders`` where a request may lead; ``refusals`` and ``problems``
how errors are told.
``jobs`` the jobs and their store; ``running`` who runs next, how, and the processes that do it.
``entrance`` who may come in; ``data`` what is computed for those who look; ``planning`` and ``tidying`` the checks
before a job and what goes with it; ``feed`` and ``metrics`` what happens, told to many; ``dashboard`` Dask's own pages.
``api`` and ``pages`` what is seen from outside; ``app`` all of it put together, ``serving`` the process around it.
"""
