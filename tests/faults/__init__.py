"""Faults, by kind: what is lost, half-written or unclear when something goes wrong. The long version: tools/faults."""
