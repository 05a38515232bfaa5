"""What decoded rollouts show, in numbers: image similarity beside four neighbours, cycle error, video MMD, hand."""
