"""Jobs as processes, one cluster for all."""
