"""The Industrial Benchmark, a simulated gas turbine: N copies at once (:mod:`.benchmark`).

In come wanted changes of velocity, gain and shift; out come frames of six values and rewards. The
goldstone potential, start states and noise have modules of their own; :mod:`.gymnasium_api` shows
one machine, or several, behind Gymnasium's interface.
"""
