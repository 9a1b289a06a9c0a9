"""Tables and figures of a sweep, and what reads them back. Nothing is computed anew here.

In: summaries that aggregation has stored, and the thesis's numbers. Out: a table in CSV and
Markdown, figures over the proximity parameter, and stored reports for notebooks.
"""
