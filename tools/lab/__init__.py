"""What measures this project and reproduces the paper. Nothing outside the lab imports it, but for
its commands.
"""
