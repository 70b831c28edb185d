"""Repositories on disk: content-addressed blobs, immutable commits, movable refs.

ROOT/blobs/SHA256
ROOT/repos/datasets/USER/NAME/{refs.json,COMMIT.json}
"""

from __future__ import annotations

import hashlib
import json
import secrets
import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path


class HttpError(Exception):
    """An error response: HTTP status, message, and the Hub's code for the reason."""

    def __init__(self, status: int, message: str, code: str = "") -> None:
        super().__init__(message)
        self.status, self.message, self.code = status, message, code


@dataclass(frozen=True)
class File:
    """One file of a commit."""

    sha256: str
    size: int
    oid: str
    """Git's SHA-1 of the blob, or of the pointer if it is a large file."""
    lfs: bool


@dataclass(frozen=True)
class Commit:
    """A complete state of a repository."""

    sha: str
    parent: str
    title: str
    files: Mapping[str, File]


@dataclass(frozen=True)
class Refs:
    """Names for commits."""

    private: bool
    branches: Mapping[str, str]
    tags: Mapping[str, str]


def git_oid(content: bytes) -> str:
    """Git's SHA-1 of a blob."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def pointer_oid(sha256: str, size: int) -> str:
    """Git's SHA-1 of the pointer that stands for a large file."""
    text = f"version https://git-lfs.github.com/spec/v1\noid sha256:{sha256}\nsize {size}\n"
    return git_oid(text.encode())


class Store:
    """All repositories of a Hub; safe to use from many threads."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lock = threading.RLock()
        (root / "blobs").mkdir(parents=True, exist_ok=True)
        self._load = lru_cache(maxsize=64)(_load_commit)

    # --- blobs
    def blob(self, sha256: str) -> Path:
        """Where the content with that hash lies, or would lie."""
        return self.root / "blobs" / sha256

    def add_blob(self, chunks: Iterable[bytes], sha256: str = "") -> File:
        """Store content as it arrives; its hash must be ``sha256`` if one is given."""
        digest, size = hashlib.sha256(), 0
        partial = self.root / f"incoming.{secrets.token_hex(8)}"
        try:
            with partial.open("wb") as file:
                for chunk in chunks:
                    digest.update(chunk)
                    size += file.write(chunk)
            found = digest.hexdigest()
            if sha256 and found != sha256:
                raise HttpError(400, f"content has SHA-256 {found}, not {sha256}")
            partial.replace(self.blob(found))
        finally:
            partial.unlink(missing_ok=True)
        return File(found, size, pointer_oid(found, size), lfs=True)

    def add_small(self, content: bytes) -> File:
        """Store a file that git itself holds."""
        return replace(self.add_blob([content]), oid=git_oid(content), lfs=False)

    # --- repositories
    def create(self, repo: str, private: bool) -> None:
        """Make a repository (``datasets/user/name``) with its first commit."""
        with self._lock:
            folder = self._folder(repo)
            if (folder / "refs.json").exists():
                raise HttpError(409, "You already created this repo")
            folder.mkdir(parents=True, exist_ok=True)
            first = {".gitattributes": self.add_small(b"*.parquet filter=lfs diff=lfs -text\n")}
            commit = self._write_commit(repo, "", "initial commit", first)
            self._write_refs(repo, Refs(private, {"main": commit.sha}, {}))

    def refs(self, repo: str) -> Refs:
        """Branches and tags of a repository."""
        try:
            content = json.loads((self._folder(repo) / "refs.json").read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise HttpError(404, "Repository not found", "RepoNotFound") from error
        return Refs(**content)

    def commit(self, repo: str, revision: str) -> Commit:
        """The commit that a branch, a tag or a (shortened) SHA names."""
        refs = self.refs(repo)
        sha = refs.branches.get(revision) or refs.tags.get(revision) or revision
        hexadecimal = len(sha) >= 7 and set(sha) <= set("0123456789abcdef")
        found = sorted(self._folder(repo).glob(f"{sha}*.json")) if hexadecimal else []
        if not found:
            raise HttpError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return self._load(found[0])

    def history(self, repo: str, revision: str) -> list[Commit]:
        """Commits from ``revision`` back to the first."""
        commits = [self.commit(repo, revision)]
        while commits[-1].parent:
            commits.append(self.commit(repo, commits[-1].parent))
        return commits

    def advance(
        self, repo: str, branch: str, parent: str, title: str, files: Mapping[str, File | None]
    ) -> Commit:
        """Commit changed files (None: deleted) to a branch, whose head must be ``parent``."""
        with self._lock:
            refs = self.refs(repo)
            if branch not in refs.branches:
                raise HttpError(404, f"Invalid rev id: {branch}", "RevisionNotFound")
            head = self.commit(repo, refs.branches[branch])
            if parent and parent != head.sha:
                raise HttpError(412, "A commit has happened since. Please refresh and try again.")
            after = dict(head.files)
            for path, file in files.items():
                if file is not None:
                    after[path] = file
                elif after.pop(path, None) is None:
                    raise HttpError(404, "A file with this name doesn't exist", "EntryNotFound")
            commit = self._write_commit(repo, head.sha, title, after)
            self._write_refs(repo, replace(refs, branches={**refs.branches, branch: commit.sha}))
            return commit

    def tag(self, repo: str, name: str, revision: str | None) -> None:
        """Set a new tag; None removes one."""
        with self._lock:
            refs = self.refs(repo)
            self._write_refs(repo, replace(refs, tags=self._named(repo, refs.tags, name, revision)))

    def branch(self, repo: str, name: str, revision: str | None) -> None:
        """Start a branch; None removes one."""
        with self._lock:
            refs = self.refs(repo)
            branches = self._named(repo, refs.branches, name, revision)
            self._write_refs(repo, replace(refs, branches=branches))

    def _named(
        self, repo: str, names: Mapping[str, str], name: str, revision: str | None
    ) -> dict[str, str]:
        if revision is None and name not in names:
            raise HttpError(404, f"No such reference: {name}", "RevisionNotFound")
        if revision is None:
            return {key: sha for key, sha in names.items() if key != name}
        if name in names:
            raise HttpError(409, f"Reference {name} exists already")
        return {**names, name: self.commit(repo, revision).sha}

    def _folder(self, repo: str) -> Path:
        return self.root / "repos" / repo

    def _write_commit(
        self, repo: str, parent: str, title: str, files: Mapping[str, File]
    ) -> Commit:
        content = {
            "parent": parent,
            "title": title,
            "files": {path: asdict(files[path]) for path in sorted(files)},
        }
        text = json.dumps(content)
        sha = hashlib.sha1(f"{repo}\0{text}".encode(), usedforsecurity=False).hexdigest()
        _replace(self._folder(repo) / f"{sha}.json", text)
        return Commit(sha, parent, title, files)

    def _write_refs(self, repo: str, refs: Refs) -> None:
        _replace(self._folder(repo) / "refs.json", json.dumps(asdict(refs)))


def _load_commit(path: Path) -> Commit:
    content = json.loads(path.read_text(encoding="utf-8"))
    files = {name: File(**file) for name, file in content["files"].items()}
    return Commit(path.stem, content["parent"], content["title"], files)


def _replace(path: Path, text: str) -> None:
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
