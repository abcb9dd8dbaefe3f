"""The timing model applied to configs and recordings.

It finds changes that make a rack fit, and measures the response to an operator.
"""
