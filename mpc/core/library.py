"""TEMPORARY stand-in until the loader is merged."""
import re, subprocess, functools
from pathlib import Path
import cffi
from diffdrive_mpc.mpc.core.generate import generate_formulas
HERE = Path(__file__).parent
class NotCompiledError(RuntimeError): ...
def header_text():
    return (HERE / "core.h").read_text()
@functools.cache
def load_core():
    d = Path("/tmp/w/gen"); g = generate_formulas()
    (d/'ddmpc_formulas.c').write_text(g.source); (d/'ddmpc_formulas.h').write_text(g.header)
    subprocess.run(["gcc","-std=c99","-O3","-march=native","-mprefer-vector-width=512","-ffp-contract=fast","-fno-math-errno","-fno-trapping-math","-shared","-fPIC",f"-I{HERE}",f"-I{d}",*map(str,HERE.glob("*.c")),str(d/"ddmpc_formulas.c"),"-o",str(d/"core.so"),"-lm"],check=True)
    ffi = cffi.FFI()
    text = re.sub(r"(?m)^#.*\n","",re.sub(r"/\*.*?\*/","",header_text(),flags=re.S))
    ffi.cdef("typedef double real; typedef double ddmpc_time;\n"+text)
    return ffi, ffi.dlopen(str(d/"core.so"))
def load_functions(text): raise NotImplementedError
