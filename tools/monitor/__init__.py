"""Observation and control of a running rack: snapshot, holds, signals, operator commands."""
