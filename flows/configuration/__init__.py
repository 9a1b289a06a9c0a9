"""What a run is asked to do.

Here are the schema of all settings and the way to them. In come the words of a command line, the
files of conf/ and the defaults of the components. Out goes a frozen `Settings`, or a
`SettingsError` whose one sentence says what is wrong and what is valid.
"""
