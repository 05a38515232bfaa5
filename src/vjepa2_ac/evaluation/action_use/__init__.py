"""Use of the actions: does the model tell what the robot did from what it did not?"""
