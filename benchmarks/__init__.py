"""Measurements of speed, each beside a plain implementation or another library.

In: the code of `components` and `flows`, and made-up or generated data. Out: a Markdown table per
module, `python -m benchmarks.NAME`; `python -m benchmarks` prints all of them. `python -m
benchmarks.run` stores a row per hot path, with its peer and its floor, in `benchmarks/results/`.
"""
