"""The Action Score: how close are plans to the demonstrated actions?"""
