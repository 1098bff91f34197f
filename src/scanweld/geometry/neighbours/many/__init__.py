"""Many neighbours of a query: the compiled part of `HashGrid.k_nearest` and `HashGrid.within`."""
