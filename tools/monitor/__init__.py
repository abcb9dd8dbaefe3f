"""Observes and controls a running rack: snapshots, holds, signals, commands of operators."""
