"""Logs of others: CSV, Parquet and Minari, read by a declared schema, to a dataset with its card.

In: files (`tables.py`, `csv_table.py`, `minari_table.py`) and a schema (`schema.py`). Rows are read
in batches and kept in single precision (`rows.py`), cut into episodes and repaired as far as that
was asked for (`episodes.py`), and become the arrays of a dataset (`importing.py`). What looks wrong
without being impossible is a warning (`quality.py`); all of it stands in one report (`report.py`).

Whatever cannot be is refused by a `LogError`: one sentence with file, row and column. Rows are
numbered as a spreadsheet does: the header of a CSV file is row 1.
"""
