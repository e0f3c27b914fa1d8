"""A whole run, and single stages of it, as the command line and the service ask for them."""
