"""Who runs next, how, and the processes that do it: queue, runner, a try of a job, its process, the shared cluster."""
