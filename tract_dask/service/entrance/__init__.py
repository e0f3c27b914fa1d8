"""Who may come in, and where to: tokens and sessions, the gate in front of every request, headers, the data root."""
