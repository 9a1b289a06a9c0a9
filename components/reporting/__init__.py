"""Tables and figures of a sweep, made from stored summaries, and functions that read them back.

In: summaries that aggregation has stored, and the thesis's numbers. Out: a table in CSV and
Markdown, figures over the proximity parameter, and stored reports for notebooks.
"""
