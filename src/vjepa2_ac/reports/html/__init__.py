"""What does an evaluation say, on one page that opens anywhere? HTML with no network, no script and no other file."""
