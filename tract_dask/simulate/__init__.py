"""Movies with known truth."""

from .movie import simulate_movie

__all__ = ["simulate_movie"]
