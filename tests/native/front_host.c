/* A host on Windows for the front: in the folder of the FMU's library, it prints what location comes through for a URI, a
   status that comes back, and whether the library behind is let go with the instance. */
#include <windows.h>

#include "fmi2Functions.h"

static HANDLE out;

static void print(const char *text) {
    DWORD written;
    WriteFile(out, text, (DWORD)lstrlenA(text), &written, NULL);
    WriteFile(out, "\n", 1, &written, NULL);
}

int main(int count, char **words) {
    HMODULE library = LoadLibraryA("CycloidDrive.dll");
    fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)(void (*)(void))GetProcAddress(library, "fmi2Instantiate");
    fmi2FreeInstanceTYPE *let_go = (fmi2FreeInstanceTYPE *)(void (*)(void))GetProcAddress(library, "fmi2FreeInstance");
    fmi2ResetTYPE *reset = (fmi2ResetTYPE *)(void (*)(void))GetProcAddress(library, "fmi2Reset");
    fmi2Component c;
    out = GetStdHandle(STD_OUTPUT_HANDLE);
    c = instantiate("one", fmi2CoSimulation, "", words[count - 1], NULL, fmi2False, fmi2False);
    if (c == NULL) {
        return 1;
    }
    print((const char *)(void (*)(void))GetProcAddress(GetModuleHandleA("pythonfmu-export.dll"), "location"));
    print(reset(c) == fmi2Discard ? "discarded" : "lost");
    let_go(c);
    print(GetModuleHandleA("pythonfmu-export.dll") == NULL ? "let go" : "still there");
    return 0;
}
