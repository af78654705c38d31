"""What git-LFS leaves in the place of a file that it did not fetch."""

POINTER = b"version https://git-lfs"
"""How that begins."""

REFUSAL = "the pointer of git-LFS to a file, not the file; run `git lfs pull` where it comes from"
