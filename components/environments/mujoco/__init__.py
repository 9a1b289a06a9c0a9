"""The MuJoCo robots, each described by one record in :mod:`.specifications`.

In: torques. Out: frames, rewards and falls, of N copies at once (:mod:`.robots`, on
:mod:`.simulations`) or of one robot behind Gymnasium's interface (:mod:`.gymnasium_api`).
"""
