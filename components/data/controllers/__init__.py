"""Controllers that log datasets: formulas on the Industrial Benchmark, trained policies on robots.

In: histories or frames of many copies of a system. Out: their actions.
"""
