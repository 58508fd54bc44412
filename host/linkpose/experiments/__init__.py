"""The papers' experiments on simulated runs: `linkpose reproduce` prints what these modules measure.

[Link], [Thesis] and [Mice] are keys of host/docs/references.md.
"""
