"""The timing model applied to configs and recordings: changes that make a rack fit, and the
response to an operator.
"""
