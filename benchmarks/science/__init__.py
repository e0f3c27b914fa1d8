"""How well everything is measured, on simulated data with known truth; run by ``python -m benchmarks.science DATA``.

Every section (precision, jumps, occupancy, filters, scale) measures one subject and returns tables, which ``publish``
puts into docs/science.md.
"""
