"""Settings: their schema, and how they are read.

In: the words of a command line, the files of conf/, the defaults of the components. Out: a frozen
`Settings`, or a `SettingsError` whose one sentence says what is wrong and what is valid.
"""
