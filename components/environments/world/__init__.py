"""The 2-D world of thesis 6.5, in which everybody can watch what a policy does: N agents at once.

In: steps in the plane. Out: positions and rewards (:mod:`.plane`); :mod:`.gymnasium_api` offers one
agent, or several, behind Gymnasium's interface.
"""
