"""Shapes without physics."""
