"""Movies of columns with truth: what is found, and how true the stated errors are."""
