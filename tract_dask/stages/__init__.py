"""The stages of a run, each from a store to a store: convert, drift, sum, columns, fit."""
