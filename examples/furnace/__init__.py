"""A reheating furnace that is none of the benchmark's systems, see docs/worked_example.md."""
