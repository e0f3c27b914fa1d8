"""The service: jobs in a store on disk, a runner that drives the pipeline, a REST API, and web pages over that API.

``config`` what the service was started with; ``data_root`` where a request may lead; ``errors`` and ``error_handlers``
how errors are told.
``jobs`` the jobs and their store; ``runner`` who runs next, how, and the processes that do it.
``auth`` who may come in; ``views`` what is computed for those who look, in the ``process_pool``; ``checks`` and
``deletion`` the checks before a job and what goes with it; ``events`` and ``metrics`` what happens, told to many.
``api`` and ``pages`` what is seen from outside; ``app`` all of it put together, ``server`` the process around it;
``client`` asks the API, and ``notebook`` is the column editor by itself.
"""
