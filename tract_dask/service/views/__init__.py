"""What pages and API show of movies, columns and tracks."""
