"""Which pairs of points can be right together: the graph of pairwise consistency, and its largest clique.

- graph: pairs that keep their distance, as a bit matrix
- clique: the largest set of pairs that are all consistent with each other
"""
