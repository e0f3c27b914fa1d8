"""The REST API, a file a subject, each with its router."""
