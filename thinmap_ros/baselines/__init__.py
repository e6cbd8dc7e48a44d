"""What the papers compare with, and what others run: each behind the same protocol as ours."""
