"""What logs generated datasets: formulas on the Industrial Benchmark, trained policies on robots.

In come histories or frames of many copies of a system; out come their actions.
"""
