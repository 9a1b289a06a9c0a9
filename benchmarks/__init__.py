"""Measurements of speed, each beside a plain implementation or another library.

In: the code of `components` and `flows`, and made-up or generated data. Out: a Markdown table per
module, `python -m benchmarks.NAME`; `python -m benchmarks` runs all of them.
"""
