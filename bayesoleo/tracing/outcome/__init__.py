"""What a closed loop returns: the tree of results, the summary, predictions, shapes."""
