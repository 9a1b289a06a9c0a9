"""The Industrial Benchmark, a simulated gas turbine: N copies at once (:mod:`.benchmark`).

In: changes of velocity, gain and shift. Out: frames of six values, and rewards. Fatigue,
mis-calibration, start states and noise have modules of their own; :mod:`.gymnasium_api` offers one
machine, or several, behind Gymnasium's interface.
"""
