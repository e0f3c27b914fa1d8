"""Hard cases with known truth, each with what is right: files, scenes, faults and requests. See README.md."""
