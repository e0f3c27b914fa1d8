"""What is shown and handed out: pictures, tracks, downloads, columns; and the workshop that computes them aside."""
