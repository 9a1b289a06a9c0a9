"""What a store holds that is damaged, and what nothing in it needs any more.

In: a store. Out: damages, each a file with a sentence, and orphans with what they cost; both are
only found here, `flows.verify` says and removes them.
"""
