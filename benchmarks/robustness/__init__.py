"""Broken inputs, and kills at random times: no crash, hang or half-written file."""
