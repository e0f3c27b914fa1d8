"""Who does the work: workers here, over SSH or SLURM, and the tasks that they get."""
