"""What the words of a report mean, for readers who train no policies."""

from typing import Final

__all__ = ["GLOSSARY", "JUDGED_GLOSSARY", "JUDGED_TERMS"]

GLOSSARY: Final = (
    ("log, dataset", "What was recorded while a controller ran the machine: states, actions and "
     "rewards. Learners see nothing else."),
    ("logged behaviour", "The controller that made the log, its random exploration included. Its "
     "return is the mean over the first 100 steps of every logged episode."),
    ("policy", "A rule that turns what is observed into an action: what a learner delivers."),
    ("return", "The sum of rewards of an episode in the real system, later ones discounted. More "
     "is better; on the Industrial Benchmark returns are negative, since rewards are costs."),
    ("10th percentile", "The return that nine in ten of the pooled policies reach or exceed: a "
     "cautious figure, as whoever deploys one policy gets one draw."),
    ("pool", "The last tenth of the snapshots of all seeds. Ten policies of five seeds hold five "
     "independent trainings, not ten."),
    ("seed", "A training from other random numbers. The spread over seeds tells luck from merit."),
    ("standard error", "The thesis's: 1.7 times the pool's standard deviation over the square root "
     "of its size. It counts policies as if they were independent, and so is too small."),
    ("95 % interval", "Of the 10th percentile: seeds are drawn with replacement, each with all of "
     "its policies, two thousand times. With five seeds or fewer it is rough and rather narrow."),
    ("λ (proximity)", "A knob of LION and its kin, set while the machine runs: 0 does what was "
     "always done, 1 what the model thinks best. “Best λ” was picked after seeing the results."),
    ("distance", "How far a policy's actions are from the logged behaviour's, on average."),
    ("score", "A return between the floor of its system (0) and the best known return (1), so that "
     "datasets can be averaged. A diverged policy scores 0."),
    ("interquartile mean", "The mean of the middle half of all runs: neither single disasters nor "
     "single strokes of luck decide it."),
    ("performance profile", "For every score, the share of runs that exceed it."),
    ("probability of improvement", "How often a run of one algorithm beats one of another on the "
     "same dataset; 50 % is a draw."),
    ("critical difference", "Nemenyi's: mean ranks that are closer are not told apart at 5 %. It "
     "takes datasets as independent, which those of one machine are not quite."),
    ("Spearman's correlation", "Whether two lists have the same order: 1 the same, 0 unrelated, −1 "
     "reversed."),
)  # fmt: skip

JUDGED_TERMS: Final = (
    ("judged from the log alone", "Estimated from recorded data, without running the policy "
     "anywhere. Judges see a part of the log that the policies have not learned from; of what is "
     "in neither part they know nothing."),
    ("ensemble", "Several networks, fitted to the judges' part of the log, that predict what "
     "follows. Policies are run in all of them; where they disagree, the error is large. Where the "
     "log is silent, they may agree and all be wrong."),
    ("least member", "The gain by the networks of the ensemble that give the least."),
    ("critics", "Networks that predict a policy's return from logged steps alone (fitted Q "
     "evaluation): another way to judge, with other mistakes."),
    ("expected gain", "A judge's estimate of a policy's return, less its estimate for the "
     "behaviour that the log shows. More than 0 is better than what was done."),
    ("±", "One standard error, of the policy's estimate and the behaviour's together: over a "
     "judge's networks and the states in which it starts. It does not know what all judges have in "
     "common, so the truth may lie much further away."),
    ("outside (of the log's support)", "The share of a policy's steps in the ensemble whose state "
     "and action are less like anything in the log than nearly all of what is familiar. There "
     "nobody knows what happens."),
    ("score", "By which choices are ordered: the gain by the ensemble (by the critics where there "
     "is none), less a price for steps outside of the log. Above 0: better than the behaviour."),
    ("distance", "How far a policy's actions are from the logged behaviour's, on average, each "
     "action scaled to -1 to 1."),
    ("promised in training", "The gain in the model that the policy was trained in. It was chosen "
     "to please that model, so this is no judgement; much more than the judges expect is a bad "
     "sign."),
)  # fmt: skip
"""Of policies that were judged and never tried."""

_SHARED: Final = ("log, dataset", "policy", "seed")

JUDGED_GLOSSARY: Final = (
    *(entry for entry in GLOSSARY if entry[0] in _SHARED),
    ("return", "The sum of the rewards of an episode's first steps, later ones discounted. More "
     "is better."),
    ("logged behaviour", "What the log shows: who or what set the actions then. In comparisons its "
     "part is taken by a policy that imitates it."),
    ("λ (proximity)", "A knob of some policies, set while the machine runs: 0 does what was always "
     "done, 1 what the model thinks best."),
    *JUDGED_TERMS,
)  # fmt: skip
"""Of a page on nothing but these."""
