"""Accuracy and cost: models compared with recordings, error against time, hard cases."""
