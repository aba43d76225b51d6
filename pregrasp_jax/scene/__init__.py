"""Slots, packing and scene banks: from objects to tightly packed scenes."""
