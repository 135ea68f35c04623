"""Rounds of the closed loop: estimate the best candidates, confirm one, add it, go on."""
