"""Requests that a service must refuse, and what one request may cost the others."""
