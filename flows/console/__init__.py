"""The operator's console: a page on which the proximity is turned while the machine runs.

In: shipped policies and those of a store. Out: pages on 127.0.0.1, recordings of sessions. What is
shown is computed in ``components.operating``; ids that a browser sends are looked up in listings
and never become paths.
"""
