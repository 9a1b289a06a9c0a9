"""Worked examples: plants that are not part of the benchmark, from their log to their control."""
