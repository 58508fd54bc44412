"""Makes protocol/vectors.json, which the host's tests read too, into a header for the native tests."""

import json
from pathlib import Path

Import("env")  # noqa: F821 - SCons puts Import and env here


def quoted(text: str) -> str:
    return json.dumps(text)


def header(vectors: dict) -> str:
    def initialiser(row: dict, *keys: str) -> str:
        return f"{{{', '.join(quoted(row[key]) for key in keys)}}},"

    rows = [f"{{{quoted(row['data'])}, {row['crc']}}}," for row in vectors["crc16"]]
    frames = [initialiser(row, "name", "payload", "frame") for row in vectors["frames"]]
    rejected = [initialiser(row, "name", "cause", "frame") for row in vectors["rejected"]]
    return "\n".join(
        [
            "#pragma once",
            "struct GoldenCrc { const char* data; unsigned crc; };",
            "struct GoldenFrame { const char* name; const char* payload; const char* frame; };",
            "struct RejectedFrame { const char* name; const char* cause; const char* frame; };",
            f"constexpr unsigned kGoldenSchemaCrc = {vectors['schema_crc']}u;",
            "const GoldenCrc kGoldenCrcs[] = {",
            *rows,
            "};",
            "const GoldenFrame kGoldenFrames[] = {",
            *frames,
            "};",
            "const RejectedFrame kRejectedFrames[] = {",
            *rejected,
            "};",
            "",
        ]
    )


project = Path(env["PROJECT_DIR"])  # noqa: F821
generated = Path(env.subst("$BUILD_DIR")) / "generated"  # noqa: F821
generated.mkdir(parents=True, exist_ok=True)
text = header(json.loads((project / "protocol" / "vectors.json").read_text()))
target = generated / "GoldenFrames.h"
if not target.exists() or target.read_text() != text:
    target.write_text(text)
env.Append(CPPPATH=[str(generated)])  # noqa: F821
