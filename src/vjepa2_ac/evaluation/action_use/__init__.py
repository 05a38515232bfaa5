"""Action use: does the model distinguish the true action from others?"""
