"""The fit of elliptical Gaussians: model, iteration, errors."""
