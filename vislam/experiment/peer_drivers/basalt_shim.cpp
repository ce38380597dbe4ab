// Lets depthai's Basalt run without a device: the calibration that it asks the device for comes from the file $DAI_CALIB.
//
//     g++ -std=c++17 -shared -fPIC -O1 basalt_shim.cpp -o shim.so -ldl     then LD_PRELOAD=shim.so, DAI_LIB=libdepthaicore…so
//
// The two functions replace dai::DeviceBase::readCalibration and getCalibration of the wheel by their names in the library;
// `result` is where the caller wants the CalibrationHandler, as the Itanium ABI returns such values.
#include <dlfcn.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <optional>

using Constructor = void (*)(void*, std::filesystem::path*, std::optional<bool>);

static void* calibration(void* result) {
    static Constructor construct = nullptr;
    if (!construct) {
        void* library = dlopen(std::getenv("DAI_LIB"), RTLD_NOW | RTLD_NOLOAD);
        construct = reinterpret_cast<Constructor>(dlsym(
            library ? library : RTLD_DEFAULT,
            "_ZN3dai18CalibrationHandlerC1ENSt10filesystem7__cxx114pathESt8optionalIbE"));
        if (!construct) {
            std::fprintf(stderr, "this depthai has another CalibrationHandler than the shim knows\n");
            std::exit(3);
        }
    }
    std::filesystem::path path(std::getenv("DAI_CALIB"));
    construct(result, &path, std::optional<bool>(false));
    return result;
}

extern "C" void* read_calibration(void* result, void* self) __asm__("_ZN3dai10DeviceBase15readCalibrationEv");
extern "C" void* read_calibration(void* result, void*) { return calibration(result); }
extern "C" void* get_calibration(void* result, void* self) __asm__("_ZN3dai10DeviceBase14getCalibrationEv");
extern "C" void* get_calibration(void* result, void*) { return calibration(result); }
